"""Finds the object at a clicked point of a page in the AOVs of the page's last frame, without tracing rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.session import Session


@dataclass(frozen=True)
class Pick:
    """Surface that is visible at a clicked point of a frame."""

    instance: int
    """Index into the scene's instances, where captures come first, then meshes."""
    gaussian: int
    """Index of the Gaussian within its capture; -1 for a mesh."""
    depth: float
    """Distance from the camera to the surface along the ray, scene units."""
    position: npt.NDArray[np.float64]
    """World position of the surface, shape (3,)."""


def picked(frame: ls.Frame, across: float, down: float) -> Pick | None:
    """Returns the surface that is visible at a point of a frame; None if the background is.

    Args:
        frame: Last frame of the page, at any resolution.
        across: Horizontal position as a fraction of the width from the left, 0 to 1.
        down: Vertical position as a fraction of the height from the top, 0 to 1.
    """
    height, width = frame.alpha.shape
    x, y = (min(max(int(share * size), 0), size - 1) for share, size in ((across, width), (down, height)))
    depth = float(frame.depth[y, x])
    if not np.isfinite(depth):
        return None
    position = frame.position[y, x].astype(np.float64)
    return Pick(int(frame.instance_index[y, x]), int(frame.gaussian_index[y, x]), depth, position)


def select(session: Session, frame: ls.Frame, across: float, down: float, *, is_level: bool) -> tuple[str, str] | None:
    """Selects the scene entry that is visible at a point of a frame; clears the selection if no surface is there.

    Args:
        session: Session whose selection changes.
        frame: Last frame of the page, as in `picked`.
        across: Horizontal position, as in `picked`.
        down: Vertical position, as in `picked`.
        is_level: True if the frame may show a reduced level of detail, where indices of Gaussians do not refer to the
            file; the description then leaves the index out.

    Returns:
        Name of the entry and a description of the point; None if nothing was selected.
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
        return entry.name, "the object is locked: unlock it in the list to edit it"
    session.select(entry.id)
    position = ", ".join(f"{x:z.4g}" for x in pick.position)
    gaussian = "" if pick.gaussian < 0 or is_level else f"Gaussian {pick.gaussian:,}, "
    return entry.name, f"{gaussian}depth {pick.depth:.4g}, at ({position})"
