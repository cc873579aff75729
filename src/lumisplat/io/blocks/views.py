"""Selects and loads the blocks that a view needs, and plans which blocks each of several workers loads.

Selecting and planning use only the index of a capture.
"""

from __future__ import annotations

import logging
import math
import os
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_whole
from lumisplat.constants import ALPHA_MIN, JACOBIAN_CLAMP, NEAR_PLANE, WINDOW_STEP
from lumisplat.errors import ConfigError, FormatError, SceneError
from lumisplat.io.blocks.storage import Block, BlockIndex, joined, open_blocks, read_rows, unpacked
from lumisplat.io.files.source import PathLike, check_memory, parsing
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.local_frame import default_near, register_box

BLOCK_PREVIEW = 2**18
"""Number of Gaussians that `thin_blocks` samples from a capture by default, enough to fit a camera to its extent."""

BLOCK_MEMORY = 5
"""Memory that Gaussians take while they are rendered, as a multiple of their size on disk.

On a CPU, 6.7 million Gaussians of 56 bytes took 1.7 GiB."""

_log = logging.getLogger("lumisplat")

_REACH = math.sqrt(-2.0 * math.log(ALPHA_MIN))
"""Radius at which a Gaussian of opacity 1 is cut off, in standard deviations."""
_DILATION_PX = _REACH * math.sqrt(0.3) + 1.0
"""Largest amount, in pixels, by which the rasteriser's filter widens a projected Gaussian, plus one pixel for
rounding."""

_CUTS_MAX = 8
"""`plan_views` splits a view that exceeds the memory into at most this many columns and this many rows of windows."""


class BlockPart(NamedTuple):
    """A block at one level of detail."""

    block: int
    """Index of the block in `BlockIndex.blocks`."""
    level: int
    """Level of detail; 0 is the finest."""


def visible_blocks(index: BlockIndex, camera: Camera, *, pixels: float = 0.0) -> list[BlockPart]:
    """Selects the blocks that an unlit, rasterised frame needs, and a level of detail for each block.

    Args:
        index: Index of the capture.
        camera: An undistorted pinhole. If it has a window, only blocks visible in the window are selected.
        pixels: Each block gets its coarsest level whose mean Gaussian size is at most this many pixels at the block's
            nearest point. 0 selects the finest level everywhere; frames are then bit for bit equal to frames of the
            whole capture.

    Raises:
        SceneError: The camera is not an undistorted pinhole, or has a rolling shutter.
    """
    if camera.model is not CameraModel.PINHOLE or camera.is_distorted or camera.camera_from_world_end is not None:
        raise SceneError(
            "blocks can be selected only for pinholes without distortion and rolling shutter: load all blocks"
        )
    visible, nearest = _visible(index, camera)
    focal = max(camera.fx, camera.fy)
    sizes = pixels * nearest / focal
    return [
        BlockPart(number, _level(index.blocks[number], sizes[number])) for number in np.flatnonzero(visible).tolist()
    ]


def load_blocks(index: BlockIndex, parts: Sequence[BlockPart]) -> Gaussians:
    """Loads the Gaussians of blocks, each at the level of detail that ``parts`` gives, in the order of ``parts``.

    Raises:
        FormatError: A file cannot be read, or the blocks do not fit into the machine's memory.
        SceneError: ``parts`` is empty.
    """
    if not parts:
        raise SceneError("no block is visible: there is nothing to render")
    needed = BLOCK_MEMORY * _bytes_of(index, parts)
    remedy = "render the image in windows, or use coarser levels for distant blocks"
    check_memory(index.folder, f"{needed // BLOCK_MEMORY // index.row_bytes:,} Gaussians", needed, remedy)
    levels = [index.blocks[part.block].levels[part.level] for part in parts]
    width = index.row_bytes // 4
    rows = (read_rows(index.folder / level.file, width, level.count) for level in levels)
    try:
        found = joined(rows, sum(level.count for level in levels), width, **index.settings)
        low, high = index.bounds
        register_box(found, low.min(axis=0), high.max(axis=0))
        return found
    except FormatError:
        raise
    except SceneError:
        for level in levels:  # find the damaged file, to name it
            with parsing(index.folder / level.file, "a block of a capture"):
                unpacked(read_rows(index.folder / level.file, width, level.count), **index.settings)
        raise


def all_blocks(index: BlockIndex, level: int = 0) -> list[BlockPart]:
    """Selects all blocks at one level; a block without this level is selected at its coarsest level."""
    return [BlockPart(number, min(level, len(block.levels) - 1)) for number, block in enumerate(index.blocks)]


def read_blocks(path: PathLike, lod: int | None = None, budget: int | None = None) -> Gaussians:
    """Loads a whole capture at one level of detail.

    Args:
        path: Folder of the capture, or the index in that folder.
        lod: Level of detail, as for `lumisplat.io.load`.
        budget: Largest number of Gaussians, as for `lumisplat.io.load`.

    Raises:
        FormatError: The capture cannot be read, or has no such level.
    """
    index = open_blocks(path)
    levels = max(len(block.levels) for block in index.blocks)
    if lod is not None and lod >= levels:
        raise FormatError(path, f"has no level {lod}: its levels are 0 (finest) to {levels - 1}")
    chosen = all_blocks(index, lod or 0)
    if lod is None and budget is not None:
        counts = [_bytes_of(index, all_blocks(index, level)) // index.row_bytes for level in range(levels)]
        fitting = [level for level in range(levels) if counts[level] <= budget]
        level = fitting[0] if fitting else levels - 1
        why = "" if fitting else f"no level has as few as {budget:,}: "
        line = "%s: %slevel %d (of 0 to %d) is loaded, with %s Gaussians"
        _log.warning(line, os.fspath(path), why, level, levels - 1, f"{counts[level]:,}")
        chosen = all_blocks(index, level)
    return load_blocks(index, chosen)


def thin_blocks(index: BlockIndex, count: int = BLOCK_PREVIEW) -> Gaussians:
    """Loads about ``count`` Gaussians, evenly spaced over the capture, to find its extent.

    If the capture has fewer Gaussians, all are loaded.

    Args:
        index: Index of the capture.
        count: Approximate number of Gaussians.

    Raises:
        FormatError: A file cannot be read.
    """
    step, width = max(1, index.count // count), index.row_bytes // 4
    first = 0
    rows: list[FloatArray] = []
    for block in index.blocks:
        level = block.levels[0]
        rows.append(read_rows(index.folder / level.file, width, level.count, slice(first, None, step)))
        first = (first - level.count) % step  # so that rows are evenly spaced across blocks
    with parsing(index.folder, "a capture in blocks"):
        return unpacked(np.concatenate(rows), **index.settings)


def _bytes_of(index: BlockIndex, parts: Sequence[BlockPart]) -> int:
    """Returns the total size on disk of blocks at the given levels of detail, bytes."""
    return index.row_bytes * sum(index.blocks[part.block].levels[part.level].count for part in parts)


def _level(block: Block, size: float) -> int:
    """Returns the coarsest level of detail whose mean Gaussian size, ``scale_mean``, is at most ``size`` scene units.

    If no level is that fine, the finest is returned.
    """
    fine = [number for number, level in enumerate(block.levels) if level.scale_mean <= size]
    return fine[-1] if fine else 0


def _visible(index: BlockIndex, camera: Camera) -> tuple[npt.NDArray[np.bool_], Doubles]:
    """Tests each block against the view frustum, widened by the radius of the block's Gaussians.

    Returns:
        Whether each block may be visible, and the view depth of the block's nearest point, at least the near plane;
        shape (blocks,) each.
    """
    (low, high), scale = index.bounds, index.scale_max
    choices = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = np.where(choices[None], high[:, None], low[:, None])
    pose = camera.camera_from_world
    view = corners @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = view[..., 0], view[..., 1], view[..., 2]
    near = camera.near
    if near == NEAR_PLANE:  # the default: renderers derive it from the scene
        near = default_near(float(np.linalg.norm(high.max(axis=0) - low.min(axis=0))))
    outside = np.array((z <= near * (1.0 - 1e-5)).all(axis=1), np.bool_)
    (left, top), (width, height) = camera.image_corner, camera.image_size
    sides = (x, camera.cx, camera.fx, camera.width, left, width), (y, camera.cy, camera.fy, camera.height, top, height)
    for across, center, focal, size, first, count in sides:
        margin = (JACOBIAN_CLAMP - 1.0) * 0.5 * size / focal
        steepest = max(abs(center + 0.5), abs(size + 0.5 - center)) / focal + margin
        reach = _REACH * scale * math.sqrt(1.0 + steepest * steepest)
        ends = (first - center - _DILATION_PX) / focal, (first + count - center + _DILATION_PX) / focal
        # Exact in front of the eye. The test and the near plane are linear, so it also holds for blocks partly behind.
        outside |= (across - ends[1] * z > reach[:, None]).all(axis=1)
        outside |= (ends[0] * z - across > reach[:, None]).all(axis=1)
    nearest: Doubles = np.maximum(z.min(axis=1), near)
    return np.logical_not(outside), nearest


@dataclass(frozen=True)
class WorkerPlan:
    """Views that one worker renders, and the blocks that it loads for them."""

    views: range
    """Indices of the views that the worker renders."""
    tiles: int
    """Number of images to render: one for each whole view, and one for each window of a view that exceeds the memory.
    """
    held_bytes: int
    """Largest total size of blocks that are in memory at one time, measured in bytes on disk."""
    moved_bytes: int
    """Total size of all blocks that the worker loads, measured in bytes on disk; a block loaded twice counts twice."""
    too_large: int
    """Number of windows whose blocks do not fit into memory even though their view is split as finely as possible."""


def plan_views(
    index: BlockIndex, cameras: Sequence[Camera], workers: int, memory_bytes: int, *, pixels: float = 0.0
) -> list[WorkerPlan]:
    """Plans which blocks each worker holds and loads; each worker renders a run of consecutive views.

    A worker caches its most recently used blocks, as many as fit into its memory. A view whose blocks do not fit at
    once is split into 2 x 2, 4 x 4 or 8 x 8 windows (`Camera.windows`). Together, the windows have exactly the pixels
    of the whole view.

    Args:
        index: Index of the capture; its block files need not exist.
        cameras: Cameras of the views, in order, as for `lumisplat.io.visible_blocks`.
        workers: Number of workers.
        memory_bytes: Memory of each worker for Gaussians, in bytes on disk.
        pixels: Mean size in pixels up to which Gaussians of coarser levels may be used; 0 uses the finest level only.

    Raises:
        ConfigError: ``workers`` or ``memory_bytes`` is not a positive whole number.
        SceneError: See `lumisplat.io.visible_blocks`.
    """
    for name, value in (("workers", workers), ("memory_bytes", memory_bytes)):
        if not is_whole(value) or value < 1:
            raise ConfigError(f"{name} is {value}, expected a positive whole number")
    cuts = [worker * len(cameras) // workers for worker in range(workers + 1)]
    return [_worker(index, cameras, range(begin, end), memory_bytes, pixels) for begin, end in pairwise(cuts)]


def _worker(index: BlockIndex, cameras: Sequence[Camera], views: range, memory_bytes: int, pixels: float) -> WorkerPlan:
    """Plans the views of one worker by simulating which blocks its LRU cache loads and drops."""
    cache: OrderedDict[BlockPart, int] = OrderedDict()
    held = most = moved = tiles = too_large = 0
    for view in views:
        for parts in _windows(index, cameras[view], memory_bytes, pixels):
            tiles += 1
            too_large += _bytes_of(index, parts) > memory_bytes
            for part in parts:
                size = _bytes_of(index, [part])
                if part not in cache:
                    moved, held = moved + size, held + size
                cache[part] = size
                cache.move_to_end(part)
            needed = set(parts)
            while held > memory_bytes and (oldest := next(iter(cache))) not in needed:
                held -= cache.pop(oldest)
            most = max(most, held)
    return WorkerPlan(views, tiles, most, moved, too_large)


def _windows(index: BlockIndex, camera: Camera, memory_bytes: int, pixels: float) -> list[list[BlockPart]]:
    """Returns one list with the blocks of a view or, if these exceed the memory, one list for each window of the view.

    The view is split into as few windows as fit, at most `_CUTS_MAX` per side.
    """
    cuts = 1
    while True:
        cameras = [camera] if cuts == 1 else camera.windows(cuts, cuts)
        found = [visible_blocks(index, one, pixels=pixels) for one in cameras]
        fits = all(_bytes_of(index, parts) <= memory_bytes for parts in found)
        if fits or cuts >= _CUTS_MAX or 2 * cuts * WINDOW_STEP > min(camera.width, camera.height):
            return found
        cuts *= 2
