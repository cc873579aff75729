"""What a page shows at a point: read off its last frame, no ray is traced for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import lumisplat as ls


@dataclass(frozen=True)
class Pick:
    """What is seen at a point of a page."""

    instance: int
    """Instance in scene order: captures, then meshes."""
    gaussian: int
    """Gaussian within its capture; -1: a mesh."""
    depth: float
    """Distance from the eye, scene units."""
    position: npt.NDArray[np.float64]
    """World position, shape (3,)."""


def picked(frame: ls.Frame, across: float, down: float) -> Pick | None:
    """What a frame shows at a point; None: nothing.

    Args:
        frame: The last frame of the page, of whatever size.
        across: Share of the width, from the left, 0..1.
        down: Share of the height, from the top, 0..1.
    """
    height, width = frame.alpha.shape
    x, y = (min(max(int(share * size), 0), size - 1) for share, size in ((across, width), (down, height)))
    depth = float(frame.depth[y, x])
    if not np.isfinite(depth):
        return None
    position = frame.position[y, x].astype(np.float64)
    return Pick(int(frame.instance_index[y, x]), int(frame.gaussian_index[y, x]), depth, position)
