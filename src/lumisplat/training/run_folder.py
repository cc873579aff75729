"""Training folder beside a capture: checkpoint, PSNR curve, and images and scores of the held-out views."""

from __future__ import annotations

import json
import logging
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from enum import Enum
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from lumisplat.config import RasterConfig, RenderConfig, TrainConfig
from lumisplat.errors import FormatError
from lumisplat.io import save_cameras
from lumisplat.io.files.arrays import checked_array, read_arrays
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.scene_toml.toml_table import toml_text
from lumisplat.io.training_images.loading import ReadFrom, TrainingImage
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene
from lumisplat.training.losses import Loss
from lumisplat.training.parameters import NAMES, TrainedParameters

_RUN_FILES = (
    *("checkpoint.npz", "curve.*", "metrics.json", "exposures.json", "poses*.json", "held out", "previews"),
    *("light.npz", "materials"),
)
"""Glob patterns of the files that training and the material search write, without the files in `_MARKERS`."""
_MARKERS = ("settings.toml", "materials.npz")
"""Files whose presence marks a folder as a training folder; when a folder is emptied, they are removed last."""


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Paths and files of one training."""

    path: Path

    @classmethod
    def of(cls, output: Path) -> RunFolder:
        """Returns the training folder beside a capture: ``fox.training`` for ``fox.ply``."""
        return cls(output.with_suffix(".training"))

    @property
    def checkpoint(self) -> Path:
        """File from which the training resumes."""
        return self.path / "checkpoint.npz"

    @property
    def is_begun(self) -> bool:
        """True if the folder holds a training that can resume."""
        return self.checkpoint.exists() or (self.path / "settings.toml").exists()

    def preview(self, step: int) -> Path:
        """Returns the path of the preview image of an iteration."""
        return self.path / "previews" / f"{step:07d}.png"

    def prepare(self, *, overwrite: bool) -> None:
        """Creates the folder; with ``overwrite``, removes the files of an earlier training.

        Raises:
            FormatError: The folder cannot be created, or is not a training folder.
        """
        try:
            if overwrite and self.path.exists():
                self._empty()
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FormatError(self.path, f"cannot be created: {error.strerror or error}") from None

    def _empty(self) -> None:
        """Removes the files of an earlier training and nothing else; the marker files last."""
        stored = [self.path / name for name in _MARKERS]
        if any(self.path.iterdir()) and not any(path.exists() for path in stored):
            raise FormatError(self.path, "is not a training folder: nothing is removed")
        for path in (found for pattern in _RUN_FILES for found in self.path.glob(pattern)):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        for path in stored:
            path.unlink(missing_ok=True)

    def write_settings(self, config: TrainConfig, read_from: ReadFrom | None) -> None:
        """Writes the source of the images and all training settings, enough to repeat the training."""
        tables = {"train": asdict(config)}
        if read_from is not None:
            background = read_from.background or "transparent"
            tables = {"photographs": asdict(read_from) | {"background": background}} | tables
        _write(self.path / "settings.toml", toml_text(tables))

    def write_curve(self, curve: Curve) -> None:
        """Writes the PSNR curve as JSON."""
        _write(self.path / "curve.json", json.dumps(curve.stored))

    def write_exposures(self, exposures: dict[str, Doubles]) -> None:
        """Writes the exposure of each image, by the image's name, as three rows of four numbers."""
        stored = {name: exposure.tolist() for name, exposure in exposures.items()}
        _write(self.path / "exposures.json", json.dumps(stored, indent=2) + "\n")

    def write_poses(self, cameras: Sequence[Camera]) -> None:
        """Writes refined cameras, one file per camera model, because a camera file holds one model."""
        models = {camera.model for camera in cameras}
        for model in models:
            name = "poses.json" if len(models) == 1 else f"poses-{model.value}.json"
            save_cameras(self.path / name, [camera for camera in cameras if camera.model is model])

    def write_report(self, curve: Curve, score: HeldOutScore | None, held_out: HeldOut, gaussians: Gaussians) -> None:
        """Writes the PSNR curve as JSON and PNG, and the scores and comparison images of the held-out views."""
        self.write_curve(curve)
        with atomic_write(self.path / "curve.png") as temporary:
            curve.image().save(temporary, format="PNG")
        if score is not None:
            stored = {"psnr": score.psnr, "views": score.of_views, "gaussians": gaussians.count}
            _write(self.path / "metrics.json", json.dumps(stored, indent=2) + "\n")
            held_out.write_pairs(gaussians, self.path / "held out")


def forget_training(output: PathLike) -> None:
    """Removes a capture and the files of its training, so that the next training starts from the beginning.

    Args:
        output: The capture. Files in its training folder that `lumisplat.train` has not written are not removed.

    Raises:
        FormatError: The folder beside the capture is not a training folder, or cannot be emptied.
    """
    folder = RunFolder.of(Path(output))
    if folder.path.exists():
        folder.prepare(overwrite=True)
        with suppress(OSError):  # the folder holds other files
            folder.path.rmdir()
    try:
        Path(output).unlink(missing_ok=True)
    except OSError as error:
        raise FormatError(output, f"cannot be removed: {error.strerror or error}") from None


def _write(path: Path, text: str) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(text)


@dataclass(frozen=True, slots=True)
class HeldOutScore:
    """PSNR of a capture on images that were held out of training."""

    psnr: float
    """Mean PSNR over the held-out images, dB."""
    of_views: dict[str, float]
    """PSNR of each held-out image by name, dB."""


class HeldOut:
    """Renders the held-out views and compares them with their images.

    Args:
        images: Held-out images; may be empty.
        device: As in `lumisplat.create_renderer`.
        threads: As in `lumisplat.create_renderer`.
        config: Training settings, whose pipeline and projection render the views; None for the defaults.
    """

    def __init__(
        self,
        images: Sequence[TrainingImage],
        device: str,
        threads: int | None,
        config: TrainConfig | None = None,
    ) -> None:
        self._images = images
        self._renderer: Renderer | None = None
        if images:
            background = images[0].background or (0.0, 0.0, 0.0)
            training = config or TrainConfig()
            raster = RasterConfig(projection=training.projection)
            settings = RenderConfig(pipeline=training.pipeline, background=background, raster=raster, lighting=False)
            self._renderer = create_renderer(settings, device, threads=threads)
            self._renderer.render(Scene(), images[0].camera)  # compiles the kernels before training starts

    def psnr(self, gaussians: Gaussians) -> float | None:
        """Returns the mean PSNR over the held-out images, dB; None if no image was held out."""
        score = self.score(gaussians)
        return None if score is None else score.psnr

    def score(self, gaussians: Gaussians, progress: Callable[[str, float], None] | None = None) -> HeldOutScore | None:
        """Returns the PSNR of each held-out image over its mask; None if there is no image with a non-empty mask."""
        found: dict[str, float] = {}
        for number, image in enumerate(self._images):
            if progress is not None:
                progress("evaluating held-out images", number / len(self._images))
            mask = image.mask()
            if mask is None or mask.any():  # a mask may be empty after undistortion
                found[image.name] = masked_psnr(self.render(gaussians, image), image)
        if progress is not None:
            progress("evaluating held-out images", 1.0)
        return HeldOutScore(float(np.mean(list(found.values()))), found) if found else None

    def render(self, gaussians: Gaussians, image: TrainingImage) -> FloatArray:
        """Renders the Gaussians with an image's camera, display-referred, 0..1, shape (H, W, 3)."""
        assert self._renderer is not None
        frame = self._renderer.render(Scene([gaussians]), image.camera)
        return np.clip(frame.color, 0.0, 1.0).astype(np.float32)

    def preview(self, gaussians: Gaussians, path: Path) -> None:
        """Writes the first held-out image and, to its right, its rendered view; nothing if no image was held out."""
        if self._images:
            write_pair(path, self._images[0].pixels(), self.render(gaussians, self._images[0]))

    def write_pairs(self, gaussians: Gaussians, folder: Path) -> None:
        """Writes, for each held-out image, a file with the image and, to its right, its rendered view."""
        for image in self._images:
            write_pair(folder / f"{file_name(image.name)}.png", image.pixels(), self.render(gaussians, image))


def file_name(name: str) -> str:
    """Returns a file name, unique for each ``name``, that all file systems accept.

    Characters other than letters, digits, "-", "_" and "." become "%" and their code points.
    """
    return "".join(char if char.isalnum() or char in "-_." else f"%{ord(char):02X}" for char in name)


def masked_psnr(shown: FloatArray, image: TrainingImage) -> float:
    """Returns the PSNR of a rendered view against its image, over the image's mask, dB."""
    squared = ((shown - image.pixels()) ** 2).mean(axis=2)
    return decibels(float(np.average(squared, weights=image.mask())))


def write_pair(path: Path, image: FloatArray, shown: FloatArray) -> None:
    """Writes a PNG file with an image and, to its right, its rendered view."""
    pair = (255.0 * np.concatenate([image, shown], axis=1) + 0.5).astype(np.uint8)
    with atomic_write(path) as temporary:
        Image.fromarray(pair).save(temporary, format="PNG")


CURVE_EVERY = 50
"""Number of iterations whose mean error is one point of the training curve."""
SIZE = (960, 480)
MARGIN = 50
DOT_RADIUS = 3
"""Radius of the dots on the held-out curve, pixels."""
_TRAINING, _HELD_OUT, _LINES = (70, 120, 200), (210, 120, 30), (225, 225, 225)


@dataclass(slots=True)
class Curve:
    """PSNR curve of a training: training images averaged over `CURVE_EVERY` iterations, and held-out evaluations."""

    steps: list[int] = field(default_factory=list[int])
    """Iteration at which each point of the training curve was added."""
    squared: list[float] = field(default_factory=list[float])
    """Mean squared error of each point of the training curve, over the iterations since the point before."""
    measured: list[tuple[int, float]] = field(default_factory=list[tuple[int, float]])
    """Pairs of iteration and held-out PSNR in dB, one for each evaluation."""
    _sum: float = 0.0
    _count: int = 0

    @classmethod
    def of(cls, stored: dict[str, Any]) -> Curve:
        """Restores a curve from the dictionary that ``stored`` returned.

        Raises:
            ValueError: The dictionary is not that of a curve: iterations do not ascend, or errors are negative or not
                finite.
        """
        measured = [(int(step), float(value)) for step, value in stored["measured"]]
        steps, squared = [int(step) for step in stored["steps"]], [float(value) for value in stored["squared"]]
        curve = cls(steps, squared, measured, float(stored["sum"]), int(stored["count"]))
        ascending = all(a < b for a, b in pairwise([0, *steps]))
        sound = all(0.0 <= error < math.inf for error in (*squared, curve._sum))
        sound &= all(step > 0 and not math.isnan(value) for step, value in measured)
        if len(steps) != len(squared) or not ascending or curve._count < 0 or not sound:
            raise ValueError("not a training curve")
        return curve

    @property
    def stored(self) -> dict[str, Any]:
        """Curve as a JSON dictionary, from which `of` restores every bit.

        ``sum`` and ``count`` are the sum of squared errors and the number of iterations since the last point.
        """
        points = {"steps": self.steps, "squared": self.squared, "measured": self.measured}
        return points | {"sum": self._sum, "count": self._count}

    def add(self, step: int, loss: Loss) -> None:
        """Adds the squared error of iteration ``step``; every `CURVE_EVERY` iterations, adds a point to the curve."""
        self._sum, self._count = self._sum + loss.squared, self._count + 1
        if step % CURVE_EVERY == 0:
            self.steps.append(step)
            self.squared.append(self._sum / self._count)
            self._sum, self._count = 0.0, 0

    def measure(self, step: int, psnr: float | None) -> None:
        """Adds the PSNR of an evaluation of the held-out images; does nothing if ``psnr`` is None."""
        if psnr is not None:
            self.measured.append((step, psnr))

    @property
    def psnr(self) -> float:
        """PSNR on the training images, dB, over the iterations since the last point of the curve.

        Directly after a point was added, it is that point's PSNR; before the first iteration it is 0.
        """
        if self._count:
            return decibels(self._sum / self._count)
        return decibels(self.squared[-1]) if self.squared else 0.0

    def image(self) -> Image.Image:
        """Plots the curve: training images in blue, held-out images in orange."""
        image = Image.new("RGB", SIZE, "white")
        draw = ImageDraw.Draw(image)
        training = [(float(step), decibels(error)) for step, error in zip(self.steps, self.squared, strict=True)]
        lines = [[point for point in line if math.isfinite(point[1])] for line in (training, self.measured)]
        points = [point for line in lines for point in line]
        if not points:
            return image
        axes = _Axes.around(points)
        axes.draw(draw)
        for line, color in zip(lines, (_TRAINING, _HELD_OUT), strict=True):
            draw.line([axes.position(*point) for point in line], fill=color, width=2)
        for x, y in (axes.position(*point) for point in lines[1]):
            draw.ellipse([x - DOT_RADIUS, y - DOT_RADIUS, x + DOT_RADIUS, y + DOT_RADIUS], fill=_HELD_OUT)
        draw.text((MARGIN + 120, 16), "training", fill=_TRAINING)
        draw.text((MARGIN + 210, 16), "held out", fill=_HELD_OUT)
        return image


@dataclass(frozen=True, slots=True)
class _Axes:
    """Maps iteration and PSNR to pixels of the plot: iterations grow to the right, PSNR upwards."""

    last: float
    """Largest iteration number, at the right end."""
    low: int
    """PSNR at the bottom, dB."""
    high: int
    """PSNR at the top, dB."""

    @classmethod
    def around(cls, points: Sequence[tuple[float, float]]) -> _Axes:
        """Returns axes whose ranges contain all (iteration, PSNR) points."""
        values = [value for _, value in points]
        return cls(max(step for step, _ in points), math.floor(min(values)), math.ceil(max(values)) + 1)

    def position(self, step: float, value: float) -> tuple[float, float]:
        """Returns the pixel position of the point at iteration ``step`` and PSNR ``value``."""
        across, up = step / self.last, (value - self.low) / (self.high - self.low)
        return MARGIN + (SIZE[0] - 2 * MARGIN) * across, SIZE[1] - MARGIN - (SIZE[1] - 2 * MARGIN) * up

    def draw(self, draw: ImageDraw.ImageDraw) -> None:
        """Draws grid lines at round numbers, tick labels and axis titles."""
        draw.text((8, 16), "PSNR, dB", fill="black")
        for tick in range(self.low, self.high + 1, max((self.high - self.low) // 8, 1)):
            draw.line([self.position(0.0, tick), self.position(self.last, tick)], fill=_LINES)
            draw.text((MARGIN - 8, self.position(0.0, tick)[1]), str(tick), fill="black", anchor="rm")
        for tick in range(0, int(self.last) + 1, round_step(self.last / 8)):
            x, y = self.position(tick, self.low)
            draw.line([(x, y), (x, y + 5)], fill="black")
            draw.text((x, y + 8), f"{tick:,}", fill="black", anchor="mt")
        draw.line([self.position(0.0, self.low), self.position(self.last, self.low)], fill="black")
        draw.text((SIZE[0] / 2, SIZE[1] - 18), "iterations", fill="black", anchor="mt")


def round_step(least: float) -> int:
    """Returns the smallest of 1, 2, 5, 10, 20, 50, ... that is at least ``least``."""
    power = 10 ** max(math.floor(math.log10(max(least, 1.0))), 0)
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= least)


def decibels(squared: float) -> float:
    """Returns the PSNR in dB for a mean squared error of values in 0..1; infinite for an error of 0."""
    return -10.0 * math.log10(squared) if squared > 0.0 else math.inf


_log = logging.getLogger("lumisplat")

VERSION = 6
_PARTS = ("values", "first", "second")
RECORD = ("motion", "turns", "frames")
"""Names of the arrays of a `SplatRecord`: sums of image-position and of normal gradients, and the frames summed over.
"""
_PER_IMAGE = "photographs."
_MAY_CHANGE = ("iterations", "prune_below")
"""Settings that may have other values when a training resumes; all others must equal those of the checkpoint."""
_START_AGAIN = "or start again (--overwrite, overwrite=True)"
_REMOVE = f"remove it, {_START_AGAIN}"
_KIND = f"a training checkpoint: {_REMOVE}"


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """State of a training from which it resumes, without its settings and images."""

    iteration: int
    """Number of training iterations completed."""
    parameters: TrainedParameters
    record: dict[str, FloatArray]
    """Densification statistics of each Gaussian since the last densification, by the names in `RECORD`."""
    per_image: dict[str, Doubles] = field(default_factory=dict[str, Doubles])
    """Optimised exposures and poses of the images, with their Adam moments, by name."""


def write_checkpoint(path: Path, checkpoint: Checkpoint, curve: Curve, config: TrainConfig, images: str) -> None:
    """Writes a checkpoint atomically.

    Args:
        path: The file, .npz.
        checkpoint: State of the training.
        curve: PSNR curve so far.
        config: Training settings.
        images: Fingerprint of the training images.

    Raises:
        FormatError: The file cannot be written.
    """
    arrays: dict[str, Any] = {f"record.{name}": checkpoint.record[name] for name in RECORD}
    for part in _PARTS:
        arrays |= {f"{part}.{name}": getattr(checkpoint.parameters, part)[name] for name in NAMES}
    arrays |= {f"{_PER_IMAGE}{name}": values for name, values in checkpoint.per_image.items()}
    stored = {
        "version": VERSION,
        "iteration": checkpoint.iteration,
        "settings": plain_settings(config),
        "photographs": images,
        "curve": curve.stored,
    }
    write_state(path, arrays, stored)


def write_state(path: Path, arrays: Mapping[str, Any], about: Mapping[str, Any]) -> None:
    """Writes arrays and JSON metadata to an .npz file atomically.

    Raises:
        FormatError: The file cannot be written.
    """
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, about=np.array(json.dumps(about)), **arrays)


def read_checkpoint(path: Path, config: TrainConfig, images: str) -> tuple[Checkpoint, Curve]:
    """Reads a checkpoint and its PSNR curve.

    Args:
        path: The file, .npz.
        config: Settings of the training that resumes.
        images: Fingerprint of the images of the training that resumes.

    Raises:
        FormatError: The file cannot be read, or belongs to other settings or images; the message names the first
            setting that differs.
    """
    try:
        arrays = read_arrays(path, _KIND)
        stored = json.loads(str(arrays.pop("about")))
        check_same(path, stored, config, images)
        count = len(arrays["values.means"])
        coefficients = (config.sh_degree + 1) ** 2
        shapes = {"means": (3,), "rotations": (4,), "log_scales": (3,), "logits": (), "sh": (coefficients, 3)}
        parts = (
            {name: checked_array(arrays, f"{part}.{name}", (count, *shapes[name]), np.float32) for name in NAMES}
            for part in _PARTS
        )
        record = {name: checked_array(arrays, f"record.{name}", (count,), np.float32) for name in RECORD}
        per_image = {
            name.removeprefix(_PER_IMAGE): checked_array(arrays, name, array.shape, np.float64)
            for name, array in arrays.items()
            if name.startswith(_PER_IMAGE)
        }
        state = Checkpoint(int(stored["iteration"]), TrainedParameters(*parts), record, per_image)
        if state.iteration < 0 or count == 0:
            raise ValueError("not a training state")
        return state, Curve.of(stored["curve"])
    except FormatError:  # unreadable, or of another training
        raise
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError):
        raise _damaged(path) from None


def check_images(path: Path, checkpoint: Checkpoint, now: Checkpoint) -> None:
    """Raises a FormatError unless a checkpoint and the state ``now`` have exposures and poses of equal shapes."""
    shapes = [{name: array.shape for name, array in state.per_image.items()} for state in (checkpoint, now)]
    if shapes[0] != shapes[1]:
        raise _damaged(path)


def _damaged(path: Path) -> FormatError:
    return FormatError(path, f"is damaged, or not {_KIND}")


def check_same(path: Path, stored: dict[str, Any], config: TrainConfig, images: str) -> None:
    """Raises a FormatError unless a checkpoint was written with these settings and this fingerprint of the images."""
    if stored["version"] != VERSION:
        raise FormatError(path, f"has checkpoint version {stored['version']}, expected {VERSION}: {_REMOVE}")
    settings = plain_settings(config)
    for name in dict.fromkeys([*settings, *stored["settings"]]):
        if name in _MAY_CHANGE:
            continue
        before, now = stored["settings"].get(name), settings.get(name)
        if before != now:
            raise FormatError(
                path, f"was trained with {name} {before}, not {now}: use the earlier settings, {_START_AGAIN}"
            )
    if stored["photographs"] != images:
        raise FormatError(
            path,
            "was trained with other images, another hold-out or another background: use the earlier ones, "
            f"{_START_AGAIN}",
        )
    _check_steps(path, int(stored["iteration"]), int(stored["settings"]["iterations"]), config.iterations)


def _check_steps(path: Path, done: int, before: int, now: int) -> None:
    """Raises a FormatError if a checkpoint has completed more iterations (``done``) than are requested ``now``.

    Warns if ``now`` differs from ``before``, the number requested when the checkpoint was written.
    """
    if done > now:
        raise FormatError(
            path,
            f"has {done:,} iterations, TrainConfig.iterations is {now:,}: request at least as many, {_START_AGAIN}",
        )
    if before != now:
        _log.warning(
            "%s: resumes from iteration %s of %s and continues to %s: learning rates and schedules follow the new "
            "total, so the result differs from %s iterations in one run",
            path,
            *(f"{steps:,}" for steps in (done, before, now, now)),
        )


def plain_settings(config: TrainConfig) -> dict[str, Any]:
    """Returns the settings as JSON values; nested settings have dotted names."""
    settings = asdict(config)
    rates: dict[str, Any] = settings.pop("rates")
    plain = {name: value.value if isinstance(value, Enum) else value for name, value in settings.items()}
    return plain | {f"rates.{name}": value for name, value in rates.items()}
