"""What a page shows at a point: read off its last frame, no ray is traced for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.session import Session


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


def select(session: Session, frame: ls.Frame, across: float, down: float, *, is_level: bool) -> tuple[str, str] | None:
    """Selects what a frame shows at a point, or nothing if nothing is there.

    Args:
        session: Where it is selected.
        frame: As of `picked`.
        across: As of `picked`.
        down: As of `picked`.
        is_level: Whether the Gaussians of the frame may be those of a level.

    Returns:
        The name of the thing, and what is known of the point, in words; None: nothing was selected.
    """
    pick = picked(frame, across, down)
    if pick is None:
        session.select(None)
        return None
    try:
        entry = session.state.document.owner(pick.instance, session.options.time)
    except ls.SceneError:  # the frame is older than the scene
        return None
    if entry.id in session.locked:
        return entry.name, "it is locked: unlock it in the list to edit it"
    session.select(entry.id)
    place = ", ".join(f"{x:z.4g}" for x in pick.position)
    gaussian = "" if pick.gaussian < 0 or is_level else f"Gaussian {pick.gaussian:,}, "
    return entry.name, f"{gaussian}depth {pick.depth:.4g}, at ({place})"
