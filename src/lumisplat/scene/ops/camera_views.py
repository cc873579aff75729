"""Up and first view of a capture, from the cameras of its images."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import Camera
from lumisplat.scene.up import Vector, up_vector

_ROLL, _PITCH = 0.1, 0.35
"""Standard deviations, radians, by which people hold cameras off the horizon: about the axis, and up or down."""
_AGREE = 0.3
"""Least length of the mean of all ups; below, images do not agree on one."""
_ALL_DOWN = 0.9
"""Least length of the mean of all views if all look the same way, as from an aircraft."""
_CONVERGE = 0.35
"""Largest tangent, in the median, by which axes of cameras pass beside the point that they look at."""
_MIDDLE = 0.3
"""Share of an image, from its middle, in which the depth of what is seen there is measured."""
_COUNT = 2000
"""Largest number of cameras that are compared with each other; of more, every second, third, ..."""
_WIDEST = 2.0
"""Largest field of view of a first view, radians, of lenses that see more."""


def up_of_cameras(cameras: Sequence[Camera]) -> Vector | None:
    """Returns the unit vector that points up for most cameras, as people hold them.

    It begins with the mean of the cameras' own ups, as nerfstudio's auto-orient does. Where all look down a little,
    that mean leans; but the x axis of a camera that is held level is horizontal. Least squares weigh both by how
    people hold cameras. Cameras that were held on their side count with the side that was up. Where ups cancel and all
    cameras look the same way, as from an aircraft, up is the way from which they look.

    Args:
        cameras: At least one.

    Returns:
        None if the cameras do not agree.
    """
    right, down, forward = np.array([camera.camera_from_world[:3, :3] for camera in cameras]).transpose(1, 0, 2)
    up: Doubles = -down.mean(axis=0)
    if np.linalg.norm(up) < _AGREE:
        back = -forward.mean(axis=0)
        return up_vector(back) if np.linalg.norm(back) > _ALL_DOWN else None
    sides = np.stack([-down, down, right, -right], axis=1)
    rows = np.arange(len(sides))
    for _ in range(3):
        up /= np.linalg.norm(up)
        held = np.argmax(sides @ up, axis=1)
        own, level = sides[rows, held], sides[rows, (held + 2) % 4]
        # The sum of (level . up)^2 / roll^2, plus |up - mean own|^2 / pitch^2, is least: all may look down alike.
        across: Doubles = (_PITCH / _ROLL) ** 2 * np.einsum("ni,nj->ij", level, level)
        up = np.linalg.inv(across + np.eye(3)) @ own.mean(axis=0)
    return up_vector(np.round(up / np.linalg.norm(up), 9) + 0.0)


def first_view_of(cameras: Sequence[Camera], means: npt.NDArray[np.floating]) -> Camera:
    """Returns the camera that is nearest to all others, in place and view, focused on what it looks at.

    That is where the axes of all cameras meet; if they do not, what is seen in the middle of its image.

    Args:
        cameras: At least one.
        means: Positions of the Gaussians, world space, shape (N, 3).
    """
    some = list(cameras[:: max(1, -(-len(cameras) // _COUNT))])
    eyes = np.array([camera.eye for camera in some])
    axes = np.array([camera.camera_from_world[2, :3] for camera in some])
    apart = np.linalg.norm(eyes[:, None] - eyes, axis=2)
    apart = apart / (np.median(apart) or 1.0) + np.linalg.norm(axes[:, None] - axes, axis=2)
    chosen = some[int(np.argmin(apart.sum(axis=1)))]
    distance = _distance_to_meeting(chosen, eyes, axes) or _distance_seen(chosen, means)
    return Camera.look_at(
        chosen.eye,
        chosen.eye + distance * chosen.camera_from_world[2, :3],
        -chosen.camera_from_world[1, :3],
        width=chosen.width,
        height=chosen.height,
        fov_y=min(chosen.fov_y or 1.0, _WIDEST),
        near=1e-3 * distance,
        name=chosen.name,
    )


def _distance_to_meeting(camera: Camera, eyes: Doubles, axes: Doubles) -> float | None:
    """Returns the distance along a camera's axis to where all axes come nearest to each other; None: they do not."""
    across: Doubles = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if np.linalg.cond(across.sum(axis=0)) > 1e6:  # parallel
        return None
    inverse: Doubles = np.asarray(np.linalg.inv(across.sum(axis=0)), dtype=np.float64)
    point: Doubles = np.einsum("ij,njk,nk->i", inverse, across, eyes)
    along: Doubles = ((point - eyes) * axes).sum(axis=1)
    beside = np.linalg.norm(point - eyes - along[:, None] * axes, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = np.where(along > 0.0, beside / along, np.inf)
    distance = float((point - camera.eye) @ camera.camera_from_world[2, :3])
    return distance if distance > 0.0 and np.median(tangents) < _CONVERGE else None


def _distance_seen(camera: Camera, means: npt.NDArray[np.floating]) -> float:
    """Returns the median depth of what is seen in the middle of an image; if nothing is, that of all."""
    points = means @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    x, y, z = points.T.astype(np.float64)
    before = z > camera.near
    tangent = _MIDDLE * math.tan(0.5 * min(camera.fov_y or 1.0, _WIDEST))
    middle = before & (np.abs(x) < tangent * z) & (np.abs(y) < tangent * z)
    chosen = z[middle] if middle.any() else z[before] if before.any() else np.linalg.norm(points, axis=1)
    return float(np.median(chosen)) or 1.0
