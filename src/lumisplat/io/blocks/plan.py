"""Who loads what, where workers share the views of a capture in blocks: numbers from its index alone."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from lumisplat.config.checks import is_whole
from lumisplat.constants.parts import WINDOW_STEP
from lumisplat.errors import ConfigError
from lumisplat.io.blocks.index import BlockIndex
from lumisplat.io.blocks.views import BlockPart, bytes_of, visible_blocks
from lumisplat.scene.camera import Camera

CUTS_MAX = 8
"""Columns, and rows, of windows that a view is cut in at most."""


@dataclass(frozen=True)
class WorkerPlan:
    """What a worker does."""

    views: range
    """Numbers of its views."""
    tiles: int
    """Windows that it renders: more than views, where the blocks of one do not fit into its memory at once."""
    held_bytes: int
    """Most that it holds at once."""
    moved_bytes: int
    """All that it loads."""
    too_large: int
    """Windows whose blocks do not fit, though their view is cut in 8 x 8."""


def plan_views(
    index: BlockIndex, cameras: Sequence[Camera], workers: int, memory_bytes: int, *, pixels: float = 0.0
) -> list[WorkerPlan]:
    """What each worker holds and loads, where each takes a run of views that follow each other.

    A worker keeps the blocks that it has seen last, as many as its memory holds. A view whose blocks do not fit at once
    is cut into 2 x 2, 4 x 4 or 8 x 8 windows (`Camera.windows`), whose pixels are those of the whole view.

    Args:
        index: Of the capture; its files need not be there.
        cameras: The views in their order, as of `BlockIndex`'s ``visible``.
        workers: How many there are.
        memory_bytes: For the Gaussians that each holds, as they are on disk.
        pixels: As of `lumisplat.visible_blocks`.

    Raises:
        ConfigError: There is no worker, or no memory.
        SceneError: As of `lumisplat.visible_blocks`.
    """
    for name, value in (("workers", workers), ("memory_bytes", memory_bytes)):
        if not is_whole(value) or value < 1:
            raise ConfigError(f"{name} is {value}, expected a whole number from 1 on")
    cuts = [worker * len(cameras) // workers for worker in range(workers + 1)]
    return [_worker(index, cameras, range(begin, end), memory_bytes, pixels) for begin, end in pairwise(cuts)]


def _worker(index: BlockIndex, cameras: Sequence[Camera], views: range, memory_bytes: int, pixels: float) -> WorkerPlan:
    """The plan of one worker."""
    kept: OrderedDict[BlockPart, int] = OrderedDict()
    held = most = moved = tiles = too_large = 0
    for view in views:
        for parts in _windows(index, cameras[view], memory_bytes, pixels):
            tiles += 1
            too_large += bytes_of(index, parts) > memory_bytes
            for part in parts:
                size = bytes_of(index, [part])
                if part not in kept:
                    moved, held = moved + size, held + size
                kept[part] = size
                kept.move_to_end(part)
            wanted = set(parts)
            while held > memory_bytes and (oldest := next(iter(kept))) not in wanted:
                held -= kept.pop(oldest)
            most = max(most, held)
    return WorkerPlan(views, tiles, most, moved, too_large)


def _windows(index: BlockIndex, camera: Camera, memory_bytes: int, pixels: float) -> list[list[BlockPart]]:
    """The blocks of a view, or those of each of its windows, of which there are as few as will do."""
    cuts = 1
    while True:
        cameras = [camera] if cuts == 1 else camera.windows(cuts, cuts)
        found = [visible_blocks(index, one, pixels=pixels) for one in cameras]
        fits = all(bytes_of(index, parts) <= memory_bytes for parts in found)
        if fits or cuts >= CUTS_MAX or 2 * cuts * WINDOW_STEP > min(camera.width, camera.height):
            return found
        cuts *= 2
