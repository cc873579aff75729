"""A camera for a scene that comes without one."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.cli.input.up_axis import UpAxis, UpOption, resolved_up

_Points = npt.NDArray[np.float64]
_Array = npt.NDArray[np.floating[Any]]

FOV_Y = 0.8
"""Vertical field of view, radians: a normal lens."""
ELEVATION = 0.2
"""How far above the horizon the eye stands, radians: enough to show the ground an object stands on."""
TAIL = 0.02
"""Share of the opacity left out at each end of each axis: stray Gaussians must not set the frame."""
MARGIN = 1.05
"""Room around the box, as a factor of the distance."""
FARTHEST = 1e17
"""How far a scene may reach, in its units: a camera may stand at up to 1e18."""

_UP_AND_FRONT: dict[UpAxis, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "y-down": ((0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    "y-up": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "z-up": ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
}


def framing_camera(scene: ls.Scene, up: UpOption = "auto", width: int = 1280, height: int = 720) -> ls.Camera:
    """A camera in front of the scene, a little above, whose image the bulk of the scene fills.

    Args:
        scene: The scene to frame.
        up: ``y-down`` (seen along +z), the axes of most captures; ``y-up`` (seen along -z), as glTF has it; ``z-up``
            (seen along +y); ``auto``: y-down for a scene with a capture, y-up for one of meshes alone.
        width: Image width, pixels.
        height: Image height, pixels.

    Raises:
        SceneError: The scene is empty, or too large.
    """
    low, high = bulk_bounds(scene)
    upward, front = (np.array(axis) for axis in _UP_AND_FRONT[resolved_up(scene, up)])
    backward = np.cos(ELEVATION) * front + np.sin(ELEVATION) * upward
    center = 0.5 * (low + high)
    size = max(float(np.linalg.norm(high - low)), 1e-6)
    farthest = float(np.abs([low, high]).max())
    if farthest > FARTHEST:
        raise ls.SceneError(
            f"reaches {farthest:.3g} units away from the origin, and no camera shows all of it: give --cameras, or "
            "leave out what is far away"
        )
    # Any distance gives the orientation; the corners seen in it then give the distance at which all of them fit.
    rotation = ls.Camera.look_at(center + size * backward, center, upward).camera_from_world[:3, :3]
    corners = np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T - center
    x, y, z = rotation @ corners.T
    tan_y = np.tan(0.5 * FOV_Y)
    tan_x = tan_y * width / height
    distance = MARGIN * max((np.abs(x) / tan_x - z).max(), (np.abs(y) / tan_y - z).max(), 0.5 * size)
    return ls.Camera.look_at(
        center + distance * backward,
        center,
        upward,
        width=width,
        height=height,
        fov_y=FOV_Y,
        near=1e-3 * distance,
        name="front",
    )


def bulk_bounds(scene: ls.Scene) -> tuple[_Points, _Points]:
    """World-space corners (min, max) of a box around all meshes and the bulk of each capture's opacity, shape (3,).

    Raises:
        SceneError: The scene is empty.
    """
    boxes = [_bulk(_world(i.gaussians.means, i.transform), i.gaussians.opacities) for i in scene.splats]
    for instance in scene.meshes:
        points = _world(instance.mesh.positions, instance.transform)
        boxes.append((points.min(axis=0), points.max(axis=0)))
    if not boxes:
        raise ls.SceneError("the scene is empty: there is nothing to look at")
    lows, highs = zip(*boxes, strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _bulk(points: _Points, weights: _Array) -> tuple[_Points, _Points]:
    """Corners of the box that leaves out `TAIL` of the weights at each end of each axis."""
    low, high = np.empty(3), np.empty(3)
    for axis in range(3):
        order = np.argsort(points[:, axis])
        share = np.cumsum(weights[order], dtype=np.float64)
        first, last = np.searchsorted(share, (TAIL * share[-1], (1.0 - TAIL) * share[-1]))
        low[axis], high[axis] = points[order[first], axis], points[order[last], axis]
    return low, high


def _world(points: _Array, world_from_object: _Points) -> _Points:
    return points @ world_from_object[:3, :3].T + world_from_object[:3, 3]
