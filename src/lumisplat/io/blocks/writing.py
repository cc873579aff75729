"""A stream of Gaussians cut into blocks of space, in memory for a piece of the stream and one block."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.constants import KERNEL_DEGREE
from lumisplat.constants.blocks import BLOCK_CELLS_MAX, BLOCK_DEPTH_MAX, BLOCK_GAUSSIANS_MAX, BLOCK_LEVEL_SHARE
from lumisplat.errors import ConfigError, FormatError, SceneError
from lumisplat.io.blocks.index import GAUSSIAN_FLOATS, INDEX, Block, BlockIndex, BlockLevel
from lumisplat.io.blocks.rows import packed, pieces, read_rows, unpacked
from lumisplat.io.files.atomic import atomic_write, writers_of
from lumisplat.io.files.source import PathLike
from lumisplat.io.splats.columns import warn_lost_materials
from lumisplat.io.splats.orientation import UNSTATED, Orientation, origin_text
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.editing.decimate import decimate
from lumisplat.scene.gaussians import Gaussians

_OURS = re.compile(r"cell[0-9_-]+\.part|\d{6,}(_\d+)?\.bin|\..*\.lumisplat(\.json)?")
"""Files of a capture that is not finished."""


def write_blocks(
    folder: PathLike,
    chunks: Iterable[Gaussians],
    cell: float,
    *,
    levels: int = 0,
    block_max: int = BLOCK_GAUSSIANS_MAX,
    progress: Callable[[float], None] | None = None,
) -> BlockIndex:
    """Writes a capture in blocks of space: cubes, those with many Gaussians cut in eight, and so on.

    Args:
        folder: A new or empty folder. Its index, ``blocks.json``, is written last: a folder without it is no capture.
            If something goes wrong, what was written is removed; what a run that was killed has left, the next one
            removes.
        chunks: The capture in any order, a part at a time; means, rotations, scales, opacities and harmonics are kept,
            all of one degree; normals and materials are left out, with a log line.
        cell: Edge of the largest cubes, scene units.
        levels: Coarser levels of detail beside the finest, each with a quarter of the Gaussians of the one before, see
            `lumisplat.decimate`.
        block_max: Gaussians of a block at most; more that are in one place stay together.
        progress: Called with the fraction of all Gaussians whose blocks are made, 0..1, once all have been read.

    Raises:
        ConfigError: The cell's edge is not positive, or a number is out of range.
        SceneError: There are no Gaussians, they differ in degree or antialiasing, or have another kernel or an origin.
        FormatError: The folder holds a capture or anything else already, or cannot be written.
    """
    if not is_number(cell) or not 0.0 < cell < math.inf:
        raise ConfigError(f"cell is {cell}, expected the edge of a cube in scene units")
    if levels < 0 or block_max < 1:
        raise ConfigError(f"levels is {levels} and block_max {block_max}, expected 0 or more, and 1 or more")
    place = Path(folder)
    try:
        is_new = _made(place)
        try:
            with atomic_write(place / INDEX) as temporary:  # locked: another run sees that one is at work
                index = _Writer(place, cell, levels, block_max).write(chunks, progress or (lambda _: None))
                temporary.write_text(index.text())
            return index
        except BaseException:
            _remove_leftovers(place)
            if is_new:
                place.rmdir()
            raise
    except FormatError:
        raise
    except OSError as error:
        raise FormatError(folder, f"cannot be written: {error.strerror or error}") from None


def _made(place: Path) -> bool:
    """Makes the folder, and removes what a run that was killed has left in it; whether there was none.

    Raises:
        FormatError: There is something else in it.
        OSError: It cannot be made.
    """
    if (place / INDEX).exists():
        raise FormatError(place, "holds a complete capture in blocks: give another folder, or delete this one")
    if place.is_dir() and writers_of(place / INDEX):
        raise FormatError(place, "another process is writing blocks there: give a new folder")
    if place.exists() and not place.is_dir():
        raise FormatError(place, "is a file, expected a folder for the blocks")
    is_new = not place.exists()
    place.mkdir(parents=True, exist_ok=True)
    other = next((file.name for file in place.iterdir() if not _OURS.fullmatch(file.name)), None)
    if other is not None:
        raise FormatError(place, f"holds other files ({other}): give a new folder")
    _remove_leftovers(place)
    return is_new


def _remove_leftovers(place: Path) -> None:
    for file in place.iterdir():
        if _OURS.fullmatch(file.name):
            file.unlink()


class _Writer:
    """Sorts Gaussians into files of cells, then makes blocks of these.

    Args:
        folder: The capture's.
        cell: Edge of a cube.
        levels: Coarser levels.
        block_max: Gaussians of a block.
    """

    def __init__(self, folder: Path, cell: float, levels: int, block_max: int) -> None:
        self._folder, self._cell, self._levels, self._block_max = folder, cell, levels, block_max
        self._kind: tuple[int, bool] | None = None
        self._orientation = UNSTATED
        self._count = 0

    def write(self, chunks: Iterable[Gaussians], progress: Callable[[float], None]) -> BlockIndex:
        """Writes all blocks."""
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
            raise SceneError(f"a capture of kernel degree {chunk.kernel_degree}: blocks are rasterised, as Gaussians")
        if any(chunk.origin):
            back = ",".join(f"{-value:.12g}" for value in chunk.origin)
            raise SceneError(
                f"positions are about an origin, {origin_text(chunk.origin)}, which blocks do not have: "
                f"convert --translate={back} moves the capture to zero first"
            )
        if self._kind is None:
            self._orientation = Orientation(chunk.up, chunk.first_view)
            warn_lost_materials(self._folder, "a capture in blocks", chunk)
        if self._kind not in (None, kind):
            raise SceneError("the parts of a capture differ in the degree of their harmonics, or in antialiasing")
        self._kind = kind

    @property
    def _width(self) -> int:
        assert self._kind is not None
        return GAUSSIAN_FLOATS + 3 * self._kind[0]

    def _sort(self, rows: FloatArray, edge: float, name: str, cells: dict[tuple[int, ...], Path]) -> None:
        """Appends rows to the files of the cubes that they are in."""
        keys: npt.NDArray[np.int64] = np.floor(rows[:, :3].astype(np.float64) / edge).astype(np.int64)
        low = keys.min(axis=0)
        size = keys.max(axis=0) - low + 1
        if math.prod(size.tolist()) <= 2**16:  # so few that numbers of 16 bits are sorted, ten times faster
            place = keys - low
            codes = ((place[:, 0] * size[1] + place[:, 1]) * size[2] + place[:, 2]).astype(np.uint16)
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
            raise ConfigError(f"cell is {self._cell:g}, of which the capture would fill {more}: give a larger one")
        ordered = rows[order]
        for key, end, count in zip(found.tolist(), ends.tolist(), np.diff(ends, prepend=0).tolist(), strict=True):
            path = cells.setdefault(tuple(key), self._folder / f"{name}{'_'.join(map(str, key))}.part")
            with open(path, "ab") as file:
                file.write(ordered[end - count : end].astype("<f4", copy=False).tobytes())

    def _blocks(self, path: Path, depth: int) -> Iterator[Block]:
        """The blocks of a cube's file, which is used up."""
        count = path.stat().st_size // (4 * self._width)
        if count <= self._block_max or depth >= BLOCK_DEPTH_MAX:
            yield self._block(path, count)
            return
        edge = self._cell / 2**depth
        parts: dict[tuple[int, ...], Path] = {}
        for rows in pieces(path, self._width):
            self._sort(rows, 0.5 * edge, f"cell{depth + 1}_", parts)
        path.unlink()
        for part in sorted(parts):
            yield from self._blocks(parts[part], depth + 1)

    def _block(self, path: Path, count: int) -> Block:
        """A block of a file, and its coarser levels."""
        name = f"{self._count:06d}"
        self._count += 1
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        total = largest = 0.0
        for rows in pieces(path, self._width):
            low, high = np.minimum(low, rows[:, :3].min(axis=0)), np.maximum(high, rows[:, :3].max(axis=0))
            scales = rows[:, 7:10].max(axis=1)
            largest = max(largest, float(scales.max()))
            total += float(scales.sum(dtype=np.float64))
        path.rename(self._folder / f"{name}.bin")
        levels = [BlockLevel(f"{name}.bin", count, largest, total / count)]
        for number in range(1, self._levels + 1):
            fewer = max(1, levels[-1].count // BLOCK_LEVEL_SHARE)
            before = read_rows(self._folder / levels[-1].file, self._width, levels[-1].count)
            coarser = decimate(unpacked(before, antialiased=False), fewer)
            file = f"{name}_{number}.bin"
            (self._folder / file).write_bytes(packed(coarser).astype("<f4", copy=False).tobytes())
            scales = coarser.scales.max(axis=1)
            levels.append(BlockLevel(file, coarser.count, float(scales.max()), float(scales.mean())))
            low, high = np.minimum(low, coarser.means.min(axis=0)), np.maximum(high, coarser.means.max(axis=0))
        (x0, y0, z0), (x1, y1, z1) = low.tolist(), high.tolist()
        return Block((x0, y0, z0), (x1, y1, z1), tuple(levels))
