"""Consecutive samples of a frame, accumulated by one of several processes that share the frame."""

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
"""Names of the sums over a pixel's samples, in storage order. Only lit frames have the last two."""
_CHANNELS = {"color": 3, "alpha": 1, "radiance": 3, "squares": 3, "captured_weight": 1, "light": 3}


@dataclass(frozen=True)
class SamplePart:
    """A range of a frame's samples, summed up by one of several processes (see `lumisplat.farm.render_samples`)."""

    first: int
    """Index in the frame of the part's first sample."""
    count: int
    """Number of consecutive samples that the part sums up."""
    size: tuple[int, int]
    """Width and height of the frame in pixels."""
    accumulated: Mapping[str, FloatArray]
    """Accumulators as 32-bit words by name: sample counts, sums in double precision, and means of layers."""
    surfaces: Mapping[str, npt.NDArray[Any]]
    """Depth, normals and indices from the frame's first sample, by name; empty if the part does not begin with that
    sample."""

    @property
    def samples(self) -> int:
        """Number of samples in the part, under the name that the field has in `Frame`."""
        return self.count

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the part as ``.npz``. The file appears complete or not at all.

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
        """Reads a part written by `save`.

        Raises:
            FormatError: The file is missing, damaged, or not a part.
        """
        kind = "a part of a frame's samples"
        arrays = read_arrays(path, kind)
        try:
            first, count, width, height = checked_array(arrays, "block", (4,), np.int64).tolist()
        except ValueError:
            raise FormatError(path, f"is damaged, or not {kind}") from None
        summed, surfaces = (
            {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
            for prefix in ("sum.", "seen.")
        )
        part = SamplePart(first, count, (width, height), summed, surfaces)
        if not part._is_consistent:
            raise FormatError(path, f"is damaged, or not {kind}")
        return part

    @property
    def _is_consistent(self) -> bool:
        """True if every array has a value for each pixel, and accumulators have the number of words they need."""
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
    """Merges consecutive parts of a frame in order: sums, counts, means and variances (Chan et al. 1983).

    Args:
        parts: Parts from sample 0 on, each starting where the previous one ended; only one part is in memory at a time.

    Raises:
        ConfigError: There is no part, the parts are not consecutive, or they belong to different frames.
    """
    whole: _Merger | None = None
    for part in parts:
        if whole is None:
            if part.first != 0:
                raise ConfigError(f"the first part begins at sample {part.first}, expected 0")
            whole = _Merger(part)
        else:
            whole.add(part)
    if whole is None:
        raise ConfigError("there are no parts to merge, expected at least one")
    return whole.part()


class _Merger:
    """Merges a frame's sample parts one after another.

    Args:
        part: First part.
    """

    def __init__(self, part: SamplePart) -> None:
        self._start, self._end = part, part.first + part.count
        self._count = _counts(part)
        self._sums = _sums(part)
        self._means = _means(part)

    def add(self, part: SamplePart) -> None:
        """Merges the next part with the parts merged so far."""
        start = self._start
        if part.first != self._end:
            raise ConfigError(f"a part begins at sample {part.first}, expected {self._end}: parts must be consecutive")
        if part.size != start.size or part.accumulated.keys() != start.accumulated.keys():
            raise ConfigError("the parts differ in size or layers: they belong to different frames")
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
            mean = self._means[name]
            self._means[name] = np.where(before > 0.0, mean, 0.0) + np.where(
                more > 0.0, (means - np.where(before > 0.0, mean, 0.0)) * share, 0.0
            )
        self._count = self._count + _counts(part)
        self._end += part.count

    def part(self) -> SamplePart:
        """Returns all parts merged so far as one."""
        words: dict[str, FloatArray] = {
            "count": self._count.view(np.float32),
            "sums": np.concatenate([values.ravel() for values in self._sums.values()]).view(np.float32),
        }
        words |= {name: means.astype(np.float32).ravel() for name, means in self._means.items()}
        return SamplePart(0, self._end, self._start.size, words, self._start.surfaces)


def _counts(part: SamplePart) -> npt.NDArray[np.int32]:
    return np.ascontiguousarray(part.accumulated["count"]).view(np.int32)


def _sums(part: SamplePart) -> dict[str, Doubles]:
    """Returns the accumulated sums of a part by name, each of shape (pixels, channels)."""
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
    """Returns the means of a part's layers (AOVs) by name, each of shape (pixels, 3)."""
    layers = part.accumulated.keys() - {"count", "sums"}
    return {
        name: np.ascontiguousarray(part.accumulated[name]).reshape(-1, 3).astype(np.float64) for name in sorted(layers)
    }


def _mean(sums: Doubles, count: Doubles) -> Doubles:
    return np.divide(sums, count, out=np.zeros_like(sums), where=count > 0.0)
