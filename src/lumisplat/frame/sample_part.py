"""Some of the samples of a frame, added up: what processes that share a frame exchange."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import ConfigError, FormatError
from lumisplat.io.files.arrays import checked_array, read_arrays
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.math.arrays import Doubles, FloatArray

SUMS = ("color", "alpha", "radiance", "squares", "captured_weight", "light")
"""Sums of a pixel's samples, in the order in which they are stored; the last two are of lit frames."""
_CHANNELS = {"color": 3, "alpha": 1, "radiance": 3, "squares": 3, "captured_weight": 1, "light": 3}


@dataclass(frozen=True)
class SamplePart:
    """A block of a frame's samples, as `lumisplat.farm.render_samples` makes it."""

    first: int
    """Number of its first sample."""
    count: int
    """Of its samples."""
    size: tuple[int, int]
    """Width and height of the frame, pixels."""
    accumulated: Mapping[str, FloatArray]
    """What samples are added to, as 32-bit words by name: counts, sums in double precision, means of layers."""
    surfaces: Mapping[str, npt.NDArray[Any]]
    """What the first sample of the frame has seen; none in other parts."""

    @property
    def samples(self) -> int:
        """As of a frame: how many there are."""
        return self.count

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the part, ``.npz``. The file appears complete or not at all.

        Raises:
            FormatError: The file cannot be written.
        """
        arrays: dict[str, Any] = {"block": np.array([self.first, self.count, *self.size])}
        arrays |= {f"sum.{name}": words for name, words in self.accumulated.items()}
        arrays |= {f"seen.{name}": image for name, image in self.surfaces.items()}
        with atomic_write(path) as temporary, Path(temporary).open("wb") as stream:
            np.savez(stream, **arrays)

    @staticmethod
    def load(path: PathLike) -> SamplePart:
        """Reads a part.

        Raises:
            FormatError: The file is missing, damaged, or none of a part.
        """
        kind = "a part of a frame's samples"
        arrays = read_arrays(path, kind)
        try:
            first, count, width, height = checked_array(arrays, "block", (4,), np.int64).tolist()
        except ValueError:
            raise FormatError(path, f"is damaged, or not {kind}") from None
        summed, seen = (
            {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
            for prefix in ("sum.", "seen.")
        )
        part = SamplePart(first, count, (width, height), summed, seen)
        if not part._is_consistent:
            raise FormatError(path, f"is damaged, or not {kind}")
        return part

    @property
    def _is_consistent(self) -> bool:
        """Whether every array has a value for each pixel, in the words that samples are added up in."""
        pixels, words = self.size[0] * self.size[1], self.accumulated
        if self.first < 0 or min(self.count, *self.size) < 1 or not {"count", "sums"} <= words.keys():
            return False
        if any(array.ndim != 1 or array.dtype != np.float32 for array in words.values()):
            return False
        sums = accumulate(2 * pixels * channels for channels in _CHANNELS.values())
        lengths = {"count": (pixels,), "sums": tuple(sums)}
        return all(array.size in lengths.get(name, (3 * pixels,)) for name, array in words.items()) and all(
            array.shape[:2] == self.size[::-1] for array in self.surfaces.values()
        )


def merged(parts: Iterable[SamplePart]) -> SamplePart:
    """Parts of a frame as one, added up in their order: sums, counts, and means and squares as of Chan et al. (1983).

    Args:
        parts: From sample 0 on, each beginning where the one before has ended; one at a time is in memory.

    Raises:
        ConfigError: There is none, they do not follow each other, or they are of different frames.
    """
    whole: _Fold | None = None
    for part in parts:
        if whole is None:
            if part.first != 0:
                raise ConfigError(f"the first part begins at sample {part.first}, expected 0")
            whole = _Fold(part)
        else:
            whole.add(part)
    if whole is None:
        raise ConfigError("a frame needs a part of its samples")
    return whole.part()


class _Fold:
    """Parts that were added up so far.

    Args:
        part: The first one.
    """

    def __init__(self, part: SamplePart) -> None:
        self._start, self._end = part, part.first + part.count
        self._count = _counts(part)
        self._sums = _sums(part)
        self._means = _means(part)

    def add(self, part: SamplePart) -> None:
        """Adds the next part."""
        start = self._start
        if part.first != self._end:
            raise ConfigError(f"a part begins at sample {part.first}, expected {self._end}")
        if part.size != start.size or part.accumulated.keys() != start.accumulated.keys():
            raise ConfigError("parts of samples are of different frames: they differ in size, or in layers")
        before, more = self._count.astype(np.float64)[:, None], _counts(part).astype(np.float64)[:, None]
        total = before + more
        share = np.divide(more, total, out=np.zeros_like(total), where=total > 0.0)
        sums = _sums(part)
        both = (before > 0.0) & (more > 0.0)
        change = _mean(sums["radiance"], more) - _mean(self._sums["radiance"], before)
        between = np.where(both, change * change * (before * share), 0.0)
        for name, values in sums.items():
            self._sums[name] += values
        self._sums["squares"] += between
        for name, means in _means(part).items():
            held = self._means[name]
            self._means[name] = np.where(before > 0.0, held, 0.0) + np.where(
                more > 0.0, (means - np.where(before > 0.0, held, 0.0)) * share, 0.0
            )
        self._count = self._count + _counts(part)
        self._end += part.count

    def part(self) -> SamplePart:
        """All of them as one."""
        words: dict[str, FloatArray] = {
            "count": self._count.view(np.float32),
            "sums": np.concatenate([values.ravel() for values in self._sums.values()]).view(np.float32),
        }
        words |= {name: means.astype(np.float32).ravel() for name, means in self._means.items()}
        return SamplePart(0, self._end, self._start.size, words, self._start.surfaces)


def _counts(part: SamplePart) -> npt.NDArray[np.int32]:
    return np.ascontiguousarray(part.accumulated["count"]).view(np.int32)


def _sums(part: SamplePart) -> dict[str, Doubles]:
    """The sums of a part by name, each of shape (pixels, channels)."""
    doubles = np.ascontiguousarray(part.accumulated["sums"]).view(np.float64)
    pixels = part.size[0] * part.size[1]
    sums: dict[str, Doubles] = {}
    first = 0
    for name in SUMS:
        size = pixels * _CHANNELS[name]
        if first + size <= len(doubles):
            sums[name] = doubles[first : first + size].reshape(pixels, -1).copy()
        first += size
    return sums


def _means(part: SamplePart) -> dict[str, Doubles]:
    """Means of layers by name, each of shape (pixels, 3)."""
    layers = part.accumulated.keys() - {"count", "sums"}
    return {
        name: np.ascontiguousarray(part.accumulated[name]).reshape(-1, 3).astype(np.float64) for name in sorted(layers)
    }


def _mean(sums: Doubles, count: Doubles) -> Doubles:
    return np.divide(sums, count, out=np.zeros_like(sums), where=count > 0.0)
