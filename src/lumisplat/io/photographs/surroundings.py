"""How large a scene is, and where, told by the cameras around it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lumisplat.constants.photographs import CAMERA_MARGIN
from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import Camera


def camera_extent(cameras: Sequence[Camera]) -> float:
    """1.1 times the largest distance of a camera from the mean of their positions, scene units."""
    eyes = np.stack([camera.eye for camera in cameras])
    return CAMERA_MARGIN * float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max())


def camera_target(cameras: Sequence[Camera]) -> Doubles:
    """The point nearest to the optical axes in the sense of least squares, shape (3,).

    Of several, as where all axes are parallel, it is the one nearest to the mean of the positions.
    """
    eyes = np.stack([camera.eye for camera in cameras])
    axes = np.stack([camera.camera_from_world[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = eyes.mean(axis=0)
    inverse = np.asarray(np.linalg.pinv(across.sum(axis=0), rcond=1e-9), dtype=np.float64)
    return middle + inverse @ np.einsum("nij,nj->i", across, eyes - middle)
