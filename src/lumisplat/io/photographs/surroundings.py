"""How large a scene is, and where, told by the cameras around it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lumisplat.constants.photographs import ONE_PLACE, SAME_PLACE, SAME_TURN
from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import Camera
from lumisplat.scene.local_frame import camera_extent


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
    near = SAME_PLACE * max(camera_extent(cameras), ONE_PLACE / SAME_PLACE * float(np.abs(eyes).max()))
    found: list[int] = []
    for number, (eye, turn) in enumerate(zip(eyes, turns, strict=True)):
        same = np.linalg.norm(eyes[found] - eye, axis=1) <= near
        if turned:
            # The Frobenius norm of the difference of two rotations is 2 sqrt(2) times the sine of half their angle.
            same &= np.linalg.norm(turns[found] - turn, axis=(1, 2)) <= np.sqrt(2.0) * SAME_TURN
        if not same.any():
            found.append(number)
    return found
