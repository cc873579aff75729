"""Reads and writes streamed SOG: a ``lod-meta.json`` with a tree whose leaves have several levels of detail.

A leaf stores each level as a range of rows in a SOG capture. The writer halves the Gaussians of a leaf from level to
level.
"""

from __future__ import annotations

import json
import logging
import math
import os
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write, written_together
from lumisplat.io.files.source import STREAMED_SOG, PathLike, parsing, read_bytes, referenced_file
from lumisplat.io.splats.columns import REQUIRED, SplatColumns, joined_columns, warn_losses
from lumisplat.io.splats.orientation import orientation_of, orientation_values
from lumisplat.io.splats.sog import (
    LUMISPLAT_KEY,
    coarse_steps,
    read_sog,
    remove_file,
    sog_contents,
    warn_coarse_positions,
    write_folder,
)
from lumisplat.math.arrays import Doubles, Flags, FloatArray
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.editing.decimate import decimate
from lumisplat.scene.gaussians import Gaussians, merge_gaussians
from lumisplat.scene.ops.neighbours import sort_morton

SOG_CHUNK_COUNT = 512 * 1024
"""Approximate number of Gaussians in each SOG capture of a streamed SOG, about 7 MB, as in splat-transform.

It is also the largest number of Gaussians in a leaf of the tree."""

SOG_CHUNK_EXTENT = 16.0
"""Largest extent of a leaf of the streamed SOG's tree in scene units, as in splat-transform.

Viewers choose one level of detail for a whole leaf."""

SOG_LEAF_MIN = 8192
"""A leaf with at most this many Gaussians is not split even if the leaf is larger than `SOG_CHUNK_EXTENT`.

In a capture whose scene units are not metres, leaves could otherwise become too small."""

SOG_LEVEL_MIN = 20_000
"""Coarser levels are added as long as they have at least this many Gaussians; a viewer loads the coarsest at once."""

_log = logging.getLogger("lumisplat")

_LEVELS_MAX = 64
"""Largest number of levels of detail that a ``lod-meta.json`` may state; more are refused."""


@dataclass(frozen=True, slots=True)
class _Rows:
    """Rows of one leaf in a SOG capture: index of the capture, first row, and number of rows."""

    file: int
    offset: int
    count: int


Leaf = dict[int, _Rows]
"""A leaf of the tree: for each level of detail, 0 the finest, the rows that store its Gaussians."""


def read_streamed_sog(path: PathLike, lod: int | None = None, budget: int | None = None) -> SplatColumns:
    """Reads all leaves of a streamed SOG at one level of detail.

    Args:
        path: A ``lod-meta.json``, or the folder that holds it.
        lod: The level, 0 the finest. A leaf without this level uses the next coarser level that it has, or else its
            coarsest one. None: 0, or the level that ``budget`` chooses.
        budget: Read the finest level with at most this many Gaussians. If all levels have more, the coarsest one is
            read. A log line names the level. None: no limit.

    Raises:
        FormatError: A file is missing or damaged, there is no such level, or a capture lacks the rows of a leaf.
    """
    path = Path(path) / STREAMED_SOG if Path(path).is_dir() else Path(path)
    with parsing(path, "a streamed SOG"):
        meta = json.loads(read_bytes(path))
        levels = int(meta["lodLevels"])
        if not 0 < levels <= _LEVELS_MAX:
            raise FormatError(path, f"has {levels} levels, expected 1 to {_LEVELS_MAX}")
        leaves = [_leaf(path, lods, len(meta["filenames"]), levels) for lods in _leaves(meta["tree"])]
        level = _level(path, leaves, levels, lod, budget)
        # Grouped by path, because several names may mean one capture, which is then read once.
        captures = [os.path.normpath(referenced_file(path, str(name))) for name in meta["filenames"]]
        by_file: dict[str, list[_Rows]] = defaultdict(list)
        for rows in sorted((_at_level(leaf, level) for leaf in leaves), key=lambda rows: rows.file):
            if rows.count:
                by_file[captures[rows.file]].append(rows)
        parts = [part for file, rows in by_file.items() for part in _parts(path, Path(file), rows)]
        if meta.get("environment"):
            parts.append(read_sog(referenced_file(path, str(meta["environment"]))))
        if not parts:
            raise FormatError(path, f"holds zero Gaussians at level {level}: there is nothing to render")
        if any(part.opacities_are_logits != parts[0].opacities_are_logits for part in parts):
            raise FormatError(path, "names captures of SOG version 1 and of version 2, expected one version")
        joined = joined_columns(parts)
        return (
            replace(joined, orientation=orientation_of(path, meta[LUMISPLAT_KEY])) if LUMISPLAT_KEY in meta else joined
        )


def _leaves(tree: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yields the ``lods`` object of each leaf of the tree in ``lod-meta.json``, in the order of the file."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if "lods" in node:
            yield node["lods"]
        waiting += reversed(node.get("children") or [])


def _leaf(path: Path, lods: dict[str, Any], files: int, levels: int) -> Leaf:
    """Parses and checks the rows of a leaf.

    Args:
        path: File to name in errors.
        lods: The leaf's levels in ``lod-meta.json``.
        files: Number of SOG captures.
        levels: Number of levels of detail.
    """
    leaf: Leaf = {}
    for name, entry in lods.items():
        rows = _Rows(*(int(entry[key]) for key in ("file", "offset", "count")))
        if not (0 <= int(name) < levels and 0 <= rows.file < files and rows.offset >= 0 and rows.count >= 0):
            raise FormatError(
                path,
                f"damaged: a leaf has level {name} as {entry}, but the file has {levels} levels and {files} captures",
            )
        leaf[int(name)] = rows
    if not leaf:
        raise FormatError(path, "damaged: a leaf has no level")
    return leaf


def _level(path: Path, leaves: list[Leaf], levels: int, lod: int | None, budget: int | None) -> int:
    """Returns the level of detail to read, from ``lod`` or ``budget`` as in `read_streamed_sog`."""
    if lod is not None and not 0 <= lod < levels:
        raise FormatError(path, f"has no level {lod}: its levels are 0 (finest) to {levels - 1}")
    if budget is None:
        return lod or 0
    counts = [sum(_at_level(leaf, level).count for leaf in leaves) for level in range(levels)]
    fitting = [level for level in range(lod or 0, levels) if 0 < counts[level] <= budget]
    chosen = fitting[0] if fitting else levels - 1
    why = "" if fitting else f"no level has as few as {budget:,}: "
    line = "%s: %slevel %d (of 0 to %d) is loaded, with %s Gaussians"
    _log.warning(line, os.fspath(path), why, chosen, levels - 1, f"{counts[chosen]:,}")
    return chosen


def _at_level(leaf: Leaf, level: int) -> _Rows:
    """Returns the rows of a leaf at ``level``, or else at the next coarser level, or else at its coarsest level."""
    return leaf[min((held for held in leaf if held >= level), default=max(leaf))]


def _parts(path: Path, capture: Path, rows: list[_Rows]) -> Iterator[SplatColumns]:
    """Yields the Gaussians of the given row ranges of a SOG capture; raises `FormatError` if ranges overlap."""
    columns = read_sog(capture)
    end = 0
    for row in sorted(rows, key=lambda row: row.offset):
        if row.offset < end or row.offset + row.count > columns.count:
            raise FormatError(
                path,
                f"damaged: a leaf has rows {row.offset:,} to {row.offset + row.count:,} of {capture.parent.name}/"
                f"{capture.name}, which holds {columns.count:,} Gaussians, or it overlaps another leaf",
            )
        end = row.offset + row.count
        yield replace(columns, **{name: getattr(columns, name)[row.offset : end] for name in REQUIRED})


@dataclass(slots=True)
class _OpenCapture:
    """Gaussians of one level that wait to be written as one SOG capture, and the name of the capture's folder."""

    name: str
    parts: list[Gaussians] = field(default_factory=list[Gaussians])
    count: int = 0


class _OpenCaptures:
    """The SOG captures that a writer is filling with leaves, one for each level of detail.

    A capture with `SOG_CHUNK_COUNT` Gaussians is written to disk, and its files are appended to ``written``.
    """

    def __init__(self, folder: Path, levels: int, written: list[Path]) -> None:
        self._folder, self._written = folder, written
        self._open = [_OpenCapture(f"{level}_0") for level in range(levels)]
        self._number = [0] * levels
        self.names: list[str] = []
        """Paths of the SOG captures so far; leaves of the tree refer to a capture by its index in this list."""
        self.counts = [0] * levels
        """Number of Gaussians added so far to each level of detail."""
        self.coarse: tuple[int, float] = (0, 0.0)
        """Number of Gaussians of the finest level that are smaller than the quantisation step of their position, and
        the largest step of these Gaussians."""

    def add(self, level: int, part: Gaussians) -> dict[str, int]:
        """Appends the Gaussians ``part`` of a leaf to the open capture of a level of detail.

        Returns:
            ``file``, ``offset`` and ``count`` of the rows, as ``lod-meta.json`` stores them.
        """
        capture = self._open[level]
        name = f"{capture.name}/meta.json"
        if not capture.parts:
            self.names.append(name)
        location = {"file": self.names.index(name), "offset": capture.count, "count": part.count}
        capture.parts.append(part)
        capture.count += part.count
        self.counts[level] += part.count
        if capture.count >= SOG_CHUNK_COUNT:
            self._write(level)
        return location

    def close(self) -> None:
        """Writes the captures that are not full yet."""
        for level, capture in enumerate(self._open):
            if capture.parts:
                self._write(level)

    def _write(self, level: int) -> None:
        capture = self._open[level]
        meta = self._folder / capture.name / "meta.json"
        merged = merge_gaussians(capture.parts)
        if level == 0:
            steps = coarse_steps(merged)
            self.coarse = (self.coarse[0] + len(steps), max(self.coarse[1], float(steps.max(initial=0.0))))
        write_folder(meta, sog_contents(merged), self._written)
        self._number[level] += 1
        self._open[level] = _OpenCapture(f"{level}_{self._number[level]}")


def write_streamed_sog(path: PathLike, gaussians: Gaussians) -> None:
    """Writes a streamed SOG; ``path`` is its ``lod-meta.json``, which is removed first and written last.

    Each level has half the Gaussians of the next finer one; the coarsest has about `SOG_LEVEL_MIN`. Values are
    quantised as in `write_sog`.

    Raises:
        FormatError: A file cannot be written.
    """
    path = Path(path)
    warn_losses(path, "SOG", gaussians)
    remove_file(path)
    with written_together(path.parent) as written:
        _write_all(path, gaussians, written)


def _write_all(path: Path, gaussians: Gaussians, written: list[Path]) -> None:
    levels = level_count(gaussians.count)
    captures = _OpenCaptures(path.parent, levels, written)
    tree = _node(captures, gaussians, levels)
    captures.close()
    warn_coarse_positions(path, *captures.coarse)
    meta: dict[str, Any] = {
        "version": 1,
        "asset": {"generator": "Lumisplat"},
        "count": sum(captures.counts),
        "counts": captures.counts,
        "lodLevels": levels,
        "filenames": captures.names,
        "tree": tree,
    }
    if stated := orientation_values(gaussians.up, gaussians.first_view):
        meta[LUMISPLAT_KEY] = stated
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(meta, separators=(",", ":")))


def level_count(count: int) -> int:
    """Returns the number of levels of detail for ``count`` Gaussians, including the finest."""
    return 1 + max(0, int(math.log2(max(count, 1) / SOG_LEVEL_MIN)))


def _node(captures: _OpenCaptures, gaussians: Gaussians, levels: int) -> dict[str, Any]:
    """Returns a node of the tree as JSON, and appends the Gaussians of the leaves below it to the open captures.

    Args:
        captures: The captures being written.
        gaussians: Gaussians of the node.
        levels: Number of levels of detail.
    """
    low, high = gaussians.bounds()
    axis = int((high - low).argmax())
    most = SOG_LEAF_MIN if high[axis] - low[axis] > SOG_CHUNK_EXTENT else SOG_CHUNK_COUNT
    if gaussians.count > most and high[axis] > low[axis]:
        below = _lower_half(gaussians.means[:, axis])
        children = [_node(captures, gaussians.subset(rows), levels) for rows in (below, ~below)]
        bounds = [np.array([child["bound"][end] for child in children]) for end in ("min", "max")]
        return {"bound": _bound(bounds[0].min(axis=0), bounds[1].max(axis=0)), "children": children}
    lods: dict[str, dict[str, int]] = {}
    corners: list[tuple[Doubles, Doubles]] = []
    for level, part in enumerate(_levels(gaussians, levels)):
        lods[f"{level}"] = captures.add(level, sort_morton(part))
        corners.append(_extent(part))
    lows, highs = zip(*corners, strict=True)
    return {"bound": _bound(np.min(lows, axis=0), np.max(highs, axis=0)), "lods": lods}


def _lower_half(values: FloatArray) -> Flags:
    """Returns a mask of the numbers below the median; if there are none, of the numbers equal to the median."""
    median = np.median(values)
    below = values < median
    return below if below.any() else values <= median


def _levels(gaussians: Gaussians, levels: int) -> Iterator[Gaussians]:
    """Yields the Gaussians of a leaf at each level of detail: half as many as at the level before, at least one."""
    yield gaussians
    for _ in range(levels - 1):
        gaussians = decimate(gaussians, max(1, gaussians.count // 2))
        yield gaussians


def _extent(gaussians: Gaussians) -> tuple[Doubles, Doubles]:
    """Returns the corners of the box around the one-sigma ellipsoids, from which PlayCanvas's engine chooses levels."""
    axes = np.abs(matrices_from_quaternions(gaussians.rotations_wxyz))
    reach = np.einsum("nij,nj->ni", axes, gaussians.scales)
    return (gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)


def _bound(low: Doubles, high: Doubles) -> dict[str, list[float]]:
    return {"min": [round(float(v), 6) for v in low], "max": [round(float(v), 6) for v in high]}
