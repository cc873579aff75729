"""How large a scene is, and where, told by the cameras around it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lumisplat.constants.photographs import CAMERA_MARGIN, SAME_PLACE, SAME_TURN
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


def count_places(cameras: Sequence[Camera]) -> int:
    """From how many places cameras see, those that are as good as the same counted once."""
    return len(_different(cameras, turned=False))


def count_poses(cameras: Sequence[Camera]) -> int:
    """How many poses cameras have, those that are as good as the same counted once."""
    return len(_different(cameras, turned=True))


def _different(cameras: Sequence[Camera], *, turned: bool) -> list[int]:
    """Numbers of cameras that are in another place than all of these before them, or if ``turned`` otherwise turned."""
    eyes = np.stack([camera.eye for camera in cameras])
    turns = np.stack([camera.camera_from_world[:3, :3] for camera in cameras])
    near = SAME_PLACE * max(camera_extent(cameras), SAME_PLACE * float(np.linalg.norm(eyes, axis=1).max()))
    found: list[int] = []
    for number, (eye, turn) in enumerate(zip(eyes, turns, strict=True)):
        same = np.linalg.norm(eyes[found] - eye, axis=1) <= near
        if turned:
            # The Frobenius norm of the difference of two rotations is 2 sqrt(2) times the sine of half their angle.
            same &= np.linalg.norm(turns[found] - turn, axis=(1, 2)) <= np.sqrt(2.0) * SAME_TURN
        if not same.any():
            found.append(number)
    return found
