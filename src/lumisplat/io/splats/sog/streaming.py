"""Streamed SOG, written: space is divided among leaves, each of which is decimated to half again and again.

A level of a leaf stands for that leaf alone, so that viewers may show neighbours at different levels. See
`lumisplat.io.splats.sog.streamed` for the layout. Leaves are cells of a k-d tree over the means; captures hold rows of
many leaves, as many as make them worth a download.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.constants.sog import SOG_CHUNK_COUNT, SOG_CHUNK_EXTENT, SOG_LEAF_LEAST, SOG_LEVEL_LEAST
from lumisplat.io.files.atomic import atomic_write, written_together
from lumisplat.io.files.source import PathLike
from lumisplat.io.splats.orientation import orientation_values
from lumisplat.io.splats.sog.reader import OURS
from lumisplat.io.splats.sog.writer import (
    coarse_steps,
    remove_file,
    sog_contents,
    warn_coarse_positions,
    warn_losses,
    write_folder,
)
from lumisplat.math.arrays import Doubles, Flags, FloatArray
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.editing.decimate import decimate
from lumisplat.scene.editing.morton import sort_morton
from lumisplat.scene.gaussians import Gaussians, merge_gaussians


@dataclass(slots=True)
class _Unit:
    """A capture that is being filled with rows of leaves."""

    name: str
    parts: list[Gaussians] = field(default_factory=list[Gaussians])
    count: int = 0


class _Units:
    """The captures of all levels, written when they are full; ``written`` receives the files."""

    def __init__(self, folder: Path, levels: int, written: list[Path]) -> None:
        self._folder, self._written = folder, written
        self._open = [_Unit(f"{level}_0") for level in range(levels)]
        self._number = [0] * levels
        self.names: list[str] = []
        """As leaves refer to them."""
        self.counts = [0] * levels
        """Gaussians of each level."""
        self.coarse: tuple[int, float] = (0, 0.0)
        """As of `warn_coarse_positions`, of the finest level."""

    def add(self, level: int, part: Gaussians) -> dict[str, int]:
        """Rows for a level of a leaf; where they are, as the tree says it."""
        unit = self._open[level]
        name = f"{unit.name}/meta.json"
        if not unit.parts:
            self.names.append(name)
        place = {"file": self.names.index(name), "offset": unit.count, "count": part.count}
        unit.parts.append(part)
        unit.count += part.count
        self.counts[level] += part.count
        if unit.count >= SOG_CHUNK_COUNT:
            self._write(level)
        return place

    def close(self) -> None:
        """Writes those that are not full."""
        for level, unit in enumerate(self._open):
            if unit.parts:
                self._write(level)

    def _write(self, level: int) -> None:
        unit = self._open[level]
        meta = self._folder / unit.name / "meta.json"
        capture = merge_gaussians(unit.parts)
        if level == 0:
            steps = coarse_steps(capture)
            self.coarse = (self.coarse[0] + len(steps), max(self.coarse[1], float(steps.max(initial=0.0))))
        write_folder(meta, sog_contents(capture), self._written)
        self._number[level] += 1
        self._open[level] = _Unit(f"{level}_{self._number[level]}")


def write_streamed_sog(path: PathLike, gaussians: Gaussians) -> None:
    """Writes a streamed SOG into the folder of its ``lod-meta.json``, which goes first if it is there, and comes last.

    Each level has half the Gaussians of the one before; the coarsest has some `SOG_LEVEL_LEAST`. Values are quantised
    as by `write_sog`.

    Raises:
        FormatError: A file cannot be written.
    """
    path = Path(path)
    warn_losses(path, gaussians)
    remove_file(path)
    with written_together(path.parent) as written:
        _write_all(path, gaussians, written)


def _write_all(path: Path, gaussians: Gaussians, written: list[Path]) -> None:
    levels = level_count(gaussians.count)
    units = _Units(path.parent, levels, written)
    tree = _node(units, gaussians, levels)
    units.close()
    warn_coarse_positions(path, *units.coarse)
    meta: dict[str, Any] = {
        "version": 1,
        "asset": {"generator": "Lumisplat"},
        "count": sum(units.counts),
        "counts": units.counts,
        "lodLevels": levels,
        "filenames": units.names,
        "tree": tree,
    }
    if stated := orientation_values(gaussians.up, gaussians.first_view):
        meta[OURS] = stated
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(meta, separators=(",", ":")))


def level_count(count: int) -> int:
    """Levels of detail of so many Gaussians, the finest included."""
    return 1 + max(0, int(math.log2(max(count, 1) / SOG_LEVEL_LEAST)))


def _node(units: _Units, gaussians: Gaussians, levels: int) -> dict[str, Any]:
    """A node of the tree, whose rows are added to the captures."""
    low, high = gaussians.bounds()
    axis = int((high - low).argmax())
    most = SOG_LEAF_LEAST if high[axis] - low[axis] > SOG_CHUNK_EXTENT else SOG_CHUNK_COUNT
    if gaussians.count > most and high[axis] > low[axis]:
        below = _lower_half(gaussians.means[:, axis])
        children = [_node(units, gaussians.subset(rows), levels) for rows in (below, ~below)]
        bounds = [np.array([child["bound"][end] for child in children]) for end in ("min", "max")]
        return {"bound": _bound(bounds[0].min(axis=0), bounds[1].max(axis=0)), "children": children}
    lods: dict[str, dict[str, int]] = {}
    corners: list[tuple[Doubles, Doubles]] = []
    for level, part in enumerate(_levels(gaussians, levels)):
        lods[f"{level}"] = units.add(level, sort_morton(part))
        corners.append(_extent(part))
    lows, highs = zip(*corners, strict=True)
    return {"bound": _bound(np.min(lows, axis=0), np.max(highs, axis=0)), "lods": lods}


def _lower_half(values: FloatArray) -> Flags:
    """Which numbers are below their median, neither none nor all of them."""
    median = np.median(values)
    below = values < median
    return below if below.any() else values <= median


def _levels(gaussians: Gaussians, levels: int) -> Iterator[Gaussians]:
    """A leaf at each level, at least one Gaussian."""
    yield gaussians
    for _ in range(levels - 1):
        gaussians = decimate(gaussians, max(1, gaussians.count // 2))
        yield gaussians


def _extent(gaussians: Gaussians) -> tuple[Doubles, Doubles]:
    """Corners of a box around the ellipsoids of one standard deviation, by which PlayCanvas's engine chooses levels."""
    axes = np.abs(matrices_from_quaternions(gaussians.rotations_wxyz))
    reach = np.einsum("nij,nj->ni", axes, gaussians.scales)
    return (gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)


def _bound(low: Doubles, high: Doubles) -> dict[str, list[float]]:
    return {"min": [round(float(v), 6) for v in low], "max": [round(float(v), 6) for v in high]}
