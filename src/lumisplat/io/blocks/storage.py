"""Writes and opens captures larger than memory: an index, and spatial blocks stored as rows of float32.

Space is divided into cubes of one edge length (``cell``), and a cube with too many Gaussians is split into eight. The
Gaussians in a cube that is not split are a block. The index has the bounds, Gaussian count and file of each block.
Writing needs memory for one chunk of the input and one block.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.constants import BLOCK_GAUSSIANS_MAX, BLOCK_PIECE, KERNEL_DEGREE
from lumisplat.errors import ConfigError, FormatError, SceneError
from lumisplat.io.files.atomic import atomic_write, unfinished_writes
from lumisplat.io.files.source import BLOCKS, PathLike, parsing, read_bytes
from lumisplat.io.splats.columns import warn_lost_materials
from lumisplat.io.splats.orientation import UNSTATED, Orientation, orientation_of, orientation_values, origin_text
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.scene.editing.decimate import decimate
from lumisplat.scene.gaussians import Gaussians

BLOCK_DEPTH_MAX = 16
"""Most times that a cube is halved along each axis. Without this limit, Gaussians at one position would be split
forever.
"""

BLOCK_LEVEL_RATIO = 4
"""Factor by which the number of Gaussians falls from one level of detail to the next coarser one."""

BLOCK_CELLS_MAX = 2**16
"""Largest number of unsplit cubes; writing fails if a small ``cell`` needs more. Each of these cubes is a file while
blocks are written."""

_INDEX = BLOCKS
"""File name of the index. The index is written last, so a folder without an index is an incomplete capture."""
_VERSION = 1
_GAUSSIAN_FLOATS = 11
"""Number of floats in a stored row before the SH coefficients: mean, quaternion (wxyz), scales, opacity."""

_COLUMNS = (slice(3), slice(3, 7), slice(7, 10), 10, slice(_GAUSSIAN_FLOATS, None))
"""Columns of a stored row: 0 to 2 mean, 3 to 6 quaternion wxyz, 7 to 9 scales, 10 opacity, then the SH."""

_CAPTURE_FILES = re.compile(r"cell[0-9_-]+\.part|\d{6,}(_\d+)?\.bin|\..*\.lumisplat(\.json)?")
"""Matches names of the files that an interrupted write may leave in the folder."""


@dataclass(frozen=True)
class BlockLevel:
    """The Gaussians of a block at one level of detail."""

    file: str
    """Name of the level's file in the capture's folder. The file holds the level's Gaussians as rows of float32."""
    count: int
    scale_max: float
    """Largest standard deviation of any Gaussian of the level along any axis, scene units."""
    scale_mean: float
    """Mean of max(scale_x, scale_y, scale_z) over the Gaussians of the level, scene units."""


@dataclass(frozen=True)
class Block:
    """A spatial block of a capture: the Gaussians whose means lie in one cube."""

    low: tuple[float, float, float]
    """Smallest x, y and z of the means of all levels."""
    high: tuple[float, float, float]
    levels: tuple[BlockLevel, ...]
    """Levels of detail, from the finest to the coarsest."""


@dataclass(frozen=True)
class BlockIndex:
    """Index of a capture that is stored in blocks."""

    folder: Path
    sh_count: int
    """Number of SH coefficients per channel: 1, 4, 9 or 16."""
    antialiased: bool
    blocks: tuple[Block, ...]
    orientation: Orientation = UNSTATED
    """Up direction and first view of the capture."""

    @property
    def count(self) -> int:
        """Number of Gaussians at the finest level."""
        return sum(block.levels[0].count for block in self.blocks)

    @property
    def settings(self) -> dict[str, Any]:
        """Keyword arguments of `Gaussians` that are not arrays: antialiasing, up direction and first view."""
        return {"antialiased": self.antialiased, **self.orientation._asdict()}

    @property
    def row_bytes(self) -> int:
        """Size of a Gaussian on disk, bytes."""
        return 4 * (_GAUSSIAN_FLOATS + 3 * self.sh_count)

    @cached_property
    def scale_max(self) -> Doubles:
        """Largest standard deviation of the Gaussians of each block, scene units, shape (blocks,)."""
        return np.array([max(level.scale_max for level in block.levels) for block in self.blocks])

    @cached_property
    def bounds(self) -> tuple[Doubles, Doubles]:
        """Smallest and largest x, y and z of each block, two arrays of shape (blocks, 3)."""
        return np.array([block.low for block in self.blocks]), np.array([block.high for block in self.blocks])

    def text(self) -> str:
        """Returns the index as the JSON text that is stored."""
        blocks = [
            {
                "low": block.low,
                "high": block.high,
                "levels": [[one.file, one.count, one.scale_max, one.scale_mean] for one in block.levels],
            }
            for block in self.blocks
        ]
        head = {"version": _VERSION, "count": self.count, "sh_count": self.sh_count, "antialiased": self.antialiased}
        return json.dumps(head | orientation_values(*self.orientation) | {"blocks": blocks}) + "\n"


def open_blocks(folder: PathLike) -> BlockIndex:
    """Opens the index of a capture in blocks.

    Args:
        folder: Folder written by `lumisplat.io.write_blocks`, or its ``blocks.json``.

    Raises:
        FormatError: There is no index, it is damaged, or a file is missing or differs in size from the index.
    """
    folder = Path(folder).parent if Path(folder).name == _INDEX else Path(folder)
    path = folder / _INDEX
    with parsing(path, "an index of blocks"):
        stored: Any = json.loads(read_bytes(path))
        if stored["version"] != _VERSION:
            raise FormatError(path, f"has version {stored['version']}, expected {_VERSION}")
        index = BlockIndex(
            folder,
            _one_of(stored["sh_count"], (1, 4, 9, 16)),
            bool(stored["antialiased"]),
            tuple(_block(one) for one in stored["blocks"]),
            orientation_of(path, stored),
        )
        if not index.blocks:
            raise ValueError("it has no blocks")
        for block in index.blocks:
            for level in block.levels:
                _check_file(folder / level.file, level.count * index.row_bytes)
    return index


def _one_of(value: object, choices: tuple[int, ...]) -> int:
    if value not in choices:
        raise ValueError(f"{value} is not one of {choices}")
    return cast(int, value)


def _block(stored: Any) -> Block:
    levels = tuple(
        BlockLevel(_file_name(file), _count(count), float(largest), float(mean))
        for file, count, largest, mean in stored["levels"]
    )
    low, high = ([float(value) for value in stored[name]] for name in ("low", "high"))
    if not levels or len(low) != 3 or len(high) != 3 or not all(map(math.isfinite, (*low, *high))):
        raise ValueError("a block has no levels or no bounds")
    if not all(0.0 <= scale < math.inf for level in levels for scale in (level.scale_max, level.scale_mean)):
        raise ValueError("a block has invalid scales")
    return Block((low[0], low[1], low[2]), (high[0], high[1], high[2]), levels)


def _file_name(value: object) -> str:
    if not isinstance(value, str) or not value or not value.isprintable() or Path(value).name != value:
        raise ValueError(f"{value!r} is not the name of a file in the folder")
    return value


def _count(value: object) -> int:
    if not isinstance(value, int) or value < 1:
        raise ValueError(f"{value} is not a number of Gaussians")
    return value


def _check_file(path: Path, size: int) -> None:
    try:
        found = path.stat().st_size
    except OSError as error:
        raise FormatError(path, f"a block of the capture cannot be read: {error.strerror}") from None
    if found != size:
        raise FormatError(path, f"has {found:,} bytes, expected {size:,}: the capture is incomplete")


def packed(gaussians: Gaussians) -> FloatArray:
    """Packs N Gaussians into rows: mean, quaternion, scales, opacity and K SH coefficients, shape (N, 11 + 3 K)."""
    count = gaussians.count
    columns = (
        gaussians.means,
        gaussians.rotations_wxyz,
        gaussians.scales,
        gaussians.opacities[:, None],
        gaussians.sh.reshape(count, -1),
    )
    return np.concatenate(columns, axis=1, dtype=np.float32)


def unpacked(rows: FloatArray, **settings: Any) -> Gaussians:
    """Builds `Gaussians` from rows of `packed`; ``settings`` are keyword arguments of `joined`, such as ``up``."""
    return joined([rows], len(rows), rows.shape[1], **settings)


def joined(pieces: Iterable[FloatArray], count: int, width: int, **settings: Any) -> Gaussians:
    """Builds `Gaussians` from packed rows that arrive in pieces; besides the result, only one piece is in memory.

    Args:
        pieces: Arrays of rows, shape (rows, width) each.
        count: Total number of rows.
        width: Number of columns.
        **settings: ``antialiased``, ``up`` and ``first_view`` of `Gaussians`.
    """
    columns = [np.empty((count, *shape), np.float32) for shape in ((3,), (4,), (3,), (), ((width - _GAUSSIAN_FLOATS),))]
    first = 0
    for rows in pieces:
        here = slice(first, first + len(rows))
        for column, part in zip(columns, _COLUMNS, strict=True):
            column[here] = rows[:, part]
        first += len(rows)
    for column in columns:
        column.flags.writeable = False  # read-only arrays are not copied
    means, rotations, scales, opacities, sh = columns
    return Gaussians(means, rotations, scales, opacities, sh.reshape(count, -1, 3), **settings)


def read_rows(path: Path, width: int, count: int, chosen: slice = slice(None)) -> FloatArray:
    """Reads all rows of a block file, or a slice of them.

    Raises:
        FormatError: The file cannot be read, or has fewer rows than ``count``.
    """
    try:
        if chosen == slice(None):
            rows = np.fromfile(path, np.dtype("<f4"), count * width)
        else:
            return np.array(np.memmap(path, "<f4", "r", shape=(count, width))[chosen], np.float32)
    except ValueError:
        raise FormatError(path, "has fewer rows than the index states: write the blocks again") from None
    except OSError as error:
        raise FormatError(path, f"cannot be read: {error.strerror or error}") from None
    if len(rows) != count * width:
        raise FormatError(path, "has fewer rows than the index states: write the blocks again")
    return rows.reshape(count, width).astype(np.float32, copy=False)


def _pieces(path: Path, width: int) -> Iterator[FloatArray]:
    """Yields the rows of a file in pieces of bounded size, in order."""
    with open(path, "rb") as file:
        while content := file.read(4 * width * BLOCK_PIECE):
            yield np.frombuffer(content, "<f4").reshape(-1, width)


def write_blocks(
    folder: PathLike,
    chunks: Iterable[Gaussians],
    cell: float,
    *,
    levels: int = 0,
    block_max: int = BLOCK_GAUSSIANS_MAX,
    progress: Callable[[float], None] | None = None,
) -> BlockIndex:
    """Writes a capture as spatial blocks, one for each cube; cubes with many Gaussians are split into eight.

    Cubes are split recursively until none has more than ``block_max`` Gaussians.

    Args:
        folder: A new or empty folder. Its index, ``blocks.json``, is written last, so a folder without it is no
            capture. On failure all written files are removed. Files of a killed run are removed by the next run.
        chunks: Parts of the capture, in any order, all of one SH degree. Means, rotations, scales, opacities and SH are
            stored; normals and materials are dropped, and a log line says so.
        cell: Edge length of the largest cubes, scene units.
        levels: Number of coarser levels of detail besides the finest. Each has a quarter of the Gaussians of the
            next finer level, see `lumisplat.editing.decimate`.
        block_max: Largest number of Gaussians in a block. A block of Gaussians at one position may have more.
        progress: Called with the fraction of Gaussians whose blocks are written, 0..1, after all chunks were read.

    Raises:
        ConfigError: ``cell`` is not positive, or a number is out of range.
        SceneError: There are no Gaussians, the parts differ in SH degree or antialiasing, or a part has an origin or a
            kernel degree other than 2.
        FormatError: The folder is not empty, or cannot be written.
    """
    if not is_number(cell) or not 0.0 < cell < math.inf:
        raise ConfigError(f"cell is {cell}, expected the edge length of a cube in scene units, above 0")
    if levels < 0 or block_max < 1:
        raise ConfigError(f"levels is {levels}, expected 0 or more; block_max is {block_max}, expected 1 or more")
    target = Path(folder)
    try:
        is_new = _prepare_folder(target)
        try:
            with atomic_write(target / _INDEX) as temporary:  # the lock tells other runs that this one is active
                index = _Writer(target, cell, levels, block_max).write(chunks, progress or (lambda _: None))
                temporary.write_text(index.text())
            return index
        except BaseException:
            _remove_leftovers(target)
            if is_new:
                target.rmdir()
            raise
    except FormatError:
        raise
    except OSError as error:
        raise FormatError(folder, f"cannot be written: {error.strerror or error}") from None


def _prepare_folder(target: Path) -> bool:
    """Creates the folder of a capture, or removes a killed run's files from an old folder. Returns True if created."""
    if (target / _INDEX).exists():
        raise FormatError(target, "holds a complete capture in blocks: give another folder, or delete this one")
    if target.is_dir() and unfinished_writes(target / _INDEX):
        raise FormatError(target, "another process is writing blocks there: give a new folder")
    if target.exists() and not target.is_dir():
        raise FormatError(target, "is a file, expected a folder for the blocks")
    is_new = not target.exists()
    target.mkdir(parents=True, exist_ok=True)
    other = next((file.name for file in target.iterdir() if not _CAPTURE_FILES.fullmatch(file.name)), None)
    if other is not None:
        raise FormatError(target, f"holds other files ({other}): give a new folder")
    _remove_leftovers(target)
    return is_new


def _remove_leftovers(target: Path) -> None:
    for file in target.iterdir():
        if _CAPTURE_FILES.fullmatch(file.name):
            file.unlink()


class _Writer:
    """Sorts Gaussians into one file for each cube, then converts each file to one or several blocks.

    Args:
        folder: Folder of the capture.
        cell: Edge length of the largest cubes, scene units.
        levels: Number of coarser levels.
        block_max: Largest number of Gaussians in a block.
    """

    def __init__(self, folder: Path, cell: float, levels: int, block_max: int) -> None:
        self._folder, self._cell, self._levels, self._block_max = folder, cell, levels, block_max
        self._kind: tuple[int, bool] | None = None
        self._orientation = UNSTATED
        self._count = 0

    def write(self, chunks: Iterable[Gaussians], progress: Callable[[float], None]) -> BlockIndex:
        """Writes all blocks. Returns the index."""
        cells: dict[tuple[int, ...], Path] = {}
        for chunk in chunks:
            self._check(chunk)
            self._sort(packed(chunk), self._cell, "cell", cells)
        if self._kind is None:
            raise SceneError("zero Gaussians: there is nothing to write")
        sh_count, antialiased = self._kind
        total, blocks = sum(path.stat().st_size for path in cells.values()), list[Block]()
        done = 0
        for key in sorted(cells):
            for block in self._blocks(cells[key], 0):
                blocks.append(block)
                done += 4 * self._width * block.levels[0].count
                progress(done / total)
        return BlockIndex(self._folder, sh_count, antialiased, tuple(blocks), self._orientation)

    def _check(self, chunk: Gaussians) -> None:
        kind = chunk.sh.shape[1], chunk.antialiased
        if chunk.kernel_degree != KERNEL_DEGREE:
            raise SceneError(
                f"the capture has kernel degree {chunk.kernel_degree}: blocks support only degree {KERNEL_DEGREE}"
            )
        if any(chunk.origin):
            back = ",".join(f"{-value:.12g}" for value in chunk.origin)
            raise SceneError(
                f"positions are relative to an origin, {origin_text(chunk.origin)}, which blocks cannot store: "
                f"convert --translate={back} moves the capture to zero first"
            )
        if self._kind is None:
            self._orientation = Orientation(chunk.up, chunk.first_view)
            warn_lost_materials(self._folder, "a capture in blocks", chunk)
        if self._kind not in (None, kind):
            raise SceneError("the chunks differ in SH degree or antialiasing: expected parts of one capture")
        self._kind = kind

    @property
    def _width(self) -> int:
        assert self._kind is not None
        return _GAUSSIAN_FLOATS + 3 * self._kind[0]

    def _sort(self, rows: FloatArray, edge: float, name: str, cells: dict[tuple[int, ...], Path]) -> None:
        """Appends the row of each Gaussian to the file of the cube that contains its mean.

        Args:
            rows: Rows as from `packed`.
            edge: Edge length of the cubes, scene units.
            name: Beginning of the names of new files.
            cells: Maps the integer coordinates of a cube, floor(mean / edge), to the cube's file; new files are added.
        """
        keys: npt.NDArray[np.int64] = np.floor(rows[:, :3].astype(np.float64) / edge).astype(np.int64)
        low = keys.min(axis=0)
        size = keys.max(axis=0) - low + 1
        if math.prod(size.tolist()) <= 2**16:  # 16-bit codes sort ten times faster
            offsets = keys - low
            codes = ((offsets[:, 0] * size[1] + offsets[:, 1]) * size[2] + offsets[:, 2]).astype(np.uint16)
            order = np.argsort(codes, kind="stable")
            counts = np.bincount(codes)
            numbers = np.flatnonzero(counts)
            found = np.stack(np.unravel_index(numbers, size.tolist()), axis=1) + low
            ends = np.cumsum(counts[numbers])
        else:
            found, cell_of = np.unique(keys, axis=0, return_inverse=True)
            order = np.argsort(cell_of.ravel(), kind="stable")
            ends = np.cumsum(np.bincount(cell_of.ravel()))
        touched: list[tuple[int, ...]] = [(x, y, z) for x, y, z in found.tolist()]
        if len(cells.keys() | set(touched)) > BLOCK_CELLS_MAX:
            more = f"more than {BLOCK_CELLS_MAX:,} cubes"
            raise ConfigError(f"cell is {self._cell:g}, so the capture would fill {more}: give a larger edge length")
        ordered = rows[order]
        for key, end, count in zip(found.tolist(), ends.tolist(), np.diff(ends, prepend=0).tolist(), strict=True):
            path = cells.setdefault(tuple(key), self._folder / f"{name}{'_'.join(map(str, key))}.part")
            with open(path, "ab") as file:
                file.write(ordered[end - count : end].astype("<f4", copy=False).tobytes())

    def _blocks(self, path: Path, depth: int) -> Iterator[Block]:
        """Yields one block for a cube; a cube with too many Gaussians yields the blocks of its eight parts instead.

        Args:
            path: File with the rows of the cube; the file is removed.
            depth: Number of splits that led to this cube.
        """
        count = path.stat().st_size // (4 * self._width)
        if count <= self._block_max or depth >= BLOCK_DEPTH_MAX:
            yield self._block(path, count)
            return
        edge = self._cell / 2**depth
        parts: dict[tuple[int, ...], Path] = {}
        for rows in _pieces(path, self._width):
            self._sort(rows, 0.5 * edge, f"cell{depth + 1}_", parts)
        path.unlink()
        for part in sorted(parts):
            yield from self._blocks(parts[part], depth + 1)

    def _block(self, path: Path, count: int) -> Block:
        """Makes a block from the file of a cube with ``count`` Gaussians, and writes its coarser levels of detail."""
        name = f"{self._count:06d}"
        self._count += 1
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        total = largest = 0.0
        for rows in _pieces(path, self._width):
            low, high = np.minimum(low, rows[:, :3].min(axis=0)), np.maximum(high, rows[:, :3].max(axis=0))
            scales = rows[:, 7:10].max(axis=1)
            largest = max(largest, float(scales.max()))
            total += float(scales.sum(dtype=np.float64))
        path.rename(self._folder / f"{name}.bin")
        levels = [BlockLevel(f"{name}.bin", count, largest, total / count)]
        for number in range(1, self._levels + 1):
            fewer = max(1, levels[-1].count // BLOCK_LEVEL_RATIO)
            before = read_rows(self._folder / levels[-1].file, self._width, levels[-1].count)
            coarser = decimate(unpacked(before, antialiased=False), fewer)
            file = f"{name}_{number}.bin"
            (self._folder / file).write_bytes(packed(coarser).astype("<f4", copy=False).tobytes())
            scales = coarser.scales.max(axis=1)
            levels.append(BlockLevel(file, coarser.count, float(scales.max()), float(scales.mean())))
            low, high = np.minimum(low, coarser.means.min(axis=0)), np.maximum(high, coarser.means.max(axis=0))
        (x0, y0, z0), (x1, y1, z1) = low.tolist(), high.tolist()
        return Block((x0, y0, z0), (x1, y1, z1), tuple(levels))
