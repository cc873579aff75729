"""The state of a training as a file, from which it goes on as if it had never ended."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.config import TrainConfig
from lumisplat.errors import FormatError
from lumisplat.io.files.arrays import checked_array, read_arrays
from lumisplat.io.files.atomic import atomic_write
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.training.parameters import NAMES, TrainedParameters
from lumisplat.training.run_folder import Curve

_log = logging.getLogger("lumisplat")

VERSION = 6
_PARTS = ("values", "first", "second")
RECORD = ("motion", "turns", "frames")
"""What a `SplatRecord` has."""
_OF_PHOTOGRAPHS = "photographs."
_MAY_CHANGE = ("iterations", "prune_below")
"""Settings with others of which training goes on: what is done stays, and what comes goes by the new ones."""
BEGIN_ANEW = "remove it, or overwrite it (--overwrite, overwrite=True), to begin anew"
_KIND = f"a checkpoint of a training: {BEGIN_ANEW}"


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """Everything that the next step depends on, but for settings and photographs."""

    iteration: int
    """Steps that were made."""
    learnt: TrainedParameters
    record: dict[str, FloatArray]
    """What was noted of each Gaussian since their number changed last."""
    of_photographs: dict[str, Doubles] = field(default_factory=dict[str, Doubles])
    """What was learnt of photographs beside what they show."""


def write_checkpoint(path: Path, checkpoint: Checkpoint, curve: Curve, config: TrainConfig, photographs: str) -> None:
    """Writes a checkpoint, which appears complete or not at all.

    Args:
        path: The file, .npz.
        checkpoint: The state.
        curve: How it went so far.
        config: Settings of the training.
        photographs: What tells its photographs from others.

    Raises:
        FormatError: It cannot be written.
    """
    arrays: dict[str, Any] = {f"record.{name}": checkpoint.record[name] for name in RECORD}
    for part in _PARTS:
        arrays |= {f"{part}.{name}": getattr(checkpoint.learnt, part)[name] for name in NAMES}
    arrays |= {f"{_OF_PHOTOGRAPHS}{name}": values for name, values in checkpoint.of_photographs.items()}
    told = {
        "version": VERSION,
        "iteration": checkpoint.iteration,
        "settings": plain_settings(config),
        "photographs": photographs,
        "curve": curve.told,
    }
    arrays["about"] = np.array(json.dumps(told))
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def read_checkpoint(path: Path, config: TrainConfig, photographs: str) -> tuple[Checkpoint, Curve]:
    """Reads a checkpoint of the same settings and photographs, and how it went until then.

    Raises:
        FormatError: It cannot be read, or is of others; names the first setting that differs.
    """
    try:
        arrays = read_arrays(path, _KIND)
        told = json.loads(str(arrays.pop("about")))
        check_same(path, told, config, photographs)
        count = len(arrays["values.means"])
        coefficients = (config.sh_degree + 1) ** 2
        shapes = {"means": (3,), "rotations": (4,), "log_scales": (3,), "logits": (), "sh": (coefficients, 3)}
        parts = (
            {name: checked_array(arrays, f"{part}.{name}", (count, *shapes[name]), np.float32) for name in NAMES}
            for part in _PARTS
        )
        record = {name: checked_array(arrays, f"record.{name}", (count,), np.float32) for name in RECORD}
        of_photographs = {
            name.removeprefix(_OF_PHOTOGRAPHS): checked_array(arrays, name, array.shape, np.float64)
            for name, array in arrays.items()
            if name.startswith(_OF_PHOTOGRAPHS)
        }
        state = Checkpoint(int(told["iteration"]), TrainedParameters(*parts), record, of_photographs)
        if state.iteration < 0 or count == 0:
            raise ValueError("no state of a training")
        return state, Curve.of(told["curve"])
    except FormatError:  # of others, or unreadable
        raise
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError):
        raise _damaged(path) from None


def check_images(path: Path, checkpoint: Checkpoint, now: Checkpoint) -> None:
    """Raises a FormatError unless a checkpoint has what a training learns of each image, in the same shapes."""
    shapes = [{name: array.shape for name, array in state.of_photographs.items()} for state in (checkpoint, now)]
    if shapes[0] != shapes[1]:
        raise _damaged(path)


def _damaged(path: Path) -> FormatError:
    return FormatError(path, f"is damaged, or not {_KIND}")


def check_same(path: Path, told: dict[str, Any], config: TrainConfig, photographs: str) -> None:
    """Raises a FormatError unless a checkpoint is of these settings and photographs."""
    if told["version"] != VERSION:
        raise FormatError(path, f"is a checkpoint of version {told['version']}, expected {VERSION}: {BEGIN_ANEW}")
    settings = plain_settings(config)
    for name in dict.fromkeys([*settings, *told["settings"]]):
        if name in _MAY_CHANGE:
            continue
        before, now = told["settings"].get(name), settings.get(name)
        if before != now:
            raise FormatError(
                path, f"is of a training with {name} {before}, not {now}: use the settings of before, or overwrite it"
            )
    if told["photographs"] != photographs:
        raise FormatError(
            path,
            "is of a training with other photographs, others held out or another background: use those of before, or "
            "overwrite it",
        )
    _check_steps(path, int(told["iteration"]), int(told["settings"]["iterations"]), config.iterations)


def _check_steps(path: Path, done: int, before: int, now: int) -> None:
    """Raises a FormatError if more steps are done than are asked for; logs how training goes on if others were."""
    if done > now:
        raise FormatError(
            path,
            f"has {done:,} steps already, TrainConfig.iterations is {now:,}: ask for as many or more, or overwrite it",
        )
    if before != now:
        _log.warning(
            "%s: goes on from step %s of %s to step %s: rates and what depends on the share of steps that are done "
            "go by the new number, so that the result is not that of %s steps in one go",
            path,
            *(f"{steps:,}" for steps in (done, before, now, now)),
        )


def plain_settings(config: TrainConfig) -> dict[str, Any]:
    """Settings as JSON has them; groups by dotted names."""
    settings = asdict(config)
    rates: dict[str, Any] = settings.pop("rates")
    plain = {name: value.value if isinstance(value, Enum) else value for name, value in settings.items()}
    return plain | {f"rates.{name}": value for name, value in rates.items()}
