"""Streamed SOG: a ``lod-meta.json`` divides space among leaves, each of which has levels of detail in SOG captures.

Level 0 is the finest. A leaf names its rows of a capture for each level; a capture holds rows of many leaves.
Layout: PlayCanvas's splat-transform, and https://developer.playcanvas.com (streamed SOG).
"""

from __future__ import annotations

import json
import logging
import os
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lumisplat.errors import FormatError
from lumisplat.io.files.format import STREAMED_SOG
from lumisplat.io.files.references import referenced_file
from lumisplat.io.files.source import PathLike, parsing, read_bytes
from lumisplat.io.splats.columns import REQUIRED, SplatColumns, joined_columns
from lumisplat.io.splats.orientation import orientation_of
from lumisplat.io.splats.sog.reader import OURS, read_sog

_log = logging.getLogger("lumisplat")

LEVELS_MAX = 64
"""Levels of a file; writers halve the Gaussians from one to the next."""


@dataclass(frozen=True, slots=True)
class _Rows:
    """Rows of a capture."""

    file: int
    offset: int
    count: int


Leaf = dict[int, _Rows]
"""The rows of a leaf, by level."""


def read_streamed_sog(path: PathLike, lod: int | None = None, budget: int | None = None) -> SplatColumns:
    """Reads one level of a streamed SOG, the same for all leaves.

    Args:
        path: A ``lod-meta.json``, or the folder that holds it.
        lod: The level, 0 the finest; a leaf that lacks it shows the nearest coarser level that it has, else its
            coarsest. None: 0, or what ``budget`` says.
        budget: The finest level of no more Gaussians than this is read; if all have more, the coarsest, which is
            logged. None: no limit.

    Raises:
        FormatError: A file is missing or damaged, there is no such level, or rows are not in their capture.
    """
    path = Path(path) / STREAMED_SOG if Path(path).is_dir() else Path(path)
    with parsing(path, "a streamed SOG"):
        meta = json.loads(read_bytes(path))
        levels = int(meta["lodLevels"])
        if not 0 < levels <= LEVELS_MAX:
            raise FormatError(path, f"has {levels} levels, expected 1 to {LEVELS_MAX}")
        leaves = [_leaf(path, lods, len(meta["filenames"]), levels) for lods in _leaves(meta["tree"])]
        level = _level(path, leaves, levels, lod, budget)
        # By their paths: one capture under many names would be read many times.
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
        return replace(joined, orientation=orientation_of(path, meta[OURS])) if OURS in meta else joined


def _leaves(tree: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The levels of all leaves, in the order of the file."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if "lods" in node:
            yield node["lods"]
        waiting += reversed(node.get("children") or [])


def _leaf(path: Path, lods: dict[str, Any], files: int, levels: int) -> Leaf:
    """The rows of a leaf."""
    leaf: Leaf = {}
    for name, entry in lods.items():
        rows = _Rows(*(int(entry[key]) for key in ("file", "offset", "count")))
        if not (0 <= int(name) < levels and 0 <= rows.file < files and rows.offset >= 0 and rows.count >= 0):
            raise FormatError(path, f"damaged: level {name} of a leaf is {entry}, of {levels} levels and {files} files")
        leaf[int(name)] = rows
    if not leaf:
        raise FormatError(path, "damaged: a leaf has no level")
    return leaf


def _level(path: Path, leaves: list[Leaf], levels: int, lod: int | None, budget: int | None) -> int:
    """The level to read."""
    if lod is not None and not 0 <= lod < levels:
        raise FormatError(path, f"has no level {lod}: its levels are 0 (finest) to {levels - 1}")
    if budget is None:
        return lod or 0
    counts = [sum(_at_level(leaf, level).count for leaf in leaves) for level in range(levels)]
    fitting = [level for level in range(lod or 0, levels) if 0 < counts[level] <= budget]
    if fitting:
        return fitting[0]
    coarsest = levels - 1
    _log.warning(
        "%s: no level has %s Gaussians or fewer: level %s is loaded, with %s",
        os.fspath(path),
        f"{budget:,}",
        coarsest,
        f"{counts[coarsest]:,}",
    )
    return coarsest


def _at_level(leaf: Leaf, level: int) -> _Rows:
    """The rows of the nearest level that is no finer, or of the coarsest."""
    return leaf[min((held for held in leaf if held >= level), default=max(leaf))]


def _parts(path: Path, capture: Path, rows: list[_Rows]) -> Iterator[SplatColumns]:
    """Rows of a capture; no row is read twice."""
    columns = read_sog(capture)
    end = 0
    for row in sorted(rows, key=lambda row: row.offset):
        if row.offset < end or row.offset + row.count > columns.count:
            raise FormatError(
                path,
                f"damaged: rows {row.offset:,} to {row.offset + row.count:,} of {capture.parent.name}/{capture.name}, "
                f"which holds {columns.count:,} Gaussians, or another leaf has some of them",
            )
        end = row.offset + row.count
        yield replace(columns, **{name: getattr(columns, name)[row.offset : end] for name in REQUIRED})
