"""Cameras that go round a scene."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.constants import ANIMATION_FRAMES_MAX
from lumisplat.errors import SceneError
from lumisplat.math.transforms import axis_rotation
from lumisplat.scene.camera import Camera
from lumisplat.scene.checks import check_argument, check_whole
from lumisplat.scene.ops.framing import frame_camera, target_point
from lumisplat.scene.scene import Scene


def orbit_cameras(
    scene: Scene, count: int, camera: Camera | None = None, *, turns: float = 1.0, target: npt.ArrayLike | None = None
) -> list[Camera]:
    """Cameras on a circle about the vertical through a point, evenly spread: the first picture follows the last.

    Args:
        scene: The scene to go round; its `Scene.up_direction` is the axis.
        count: Number of cameras, at least 1.
        camera: The first one; None: one that shows the scene from the front, from where all of it is seen all the
            way round, see `frame_camera`.
        turns: How many times round, counter-clockwise seen from above; negative: clockwise.
        target: World position on the axis, shape (3,); None: the middle of the bulk of the scene.

    Returns:
        ``count`` cameras, which differ in pose and name; each sees the target where the first one does.

    Raises:
        SceneError: The scene is empty, or an argument is out of its range.
    """
    check_argument("orbit_cameras", scene, Scene, "a Scene", ": ls.Scene([gaussians]) makes one")
    check_whole("count", count, 1, ANIMATION_FRAMES_MAX)
    if not is_number(turns) or not math.isfinite(turns):
        raise SceneError(f"turns is {turns}, expected a number of turns")
    first = frame_camera(scene, target=target, all_around=True) if camera is None else camera
    check_argument("orbit_cameras", first, Camera, "a Camera")
    point = target_point(scene, target)
    return [_turned(first, scene, point, turns * k / count, f"frame_{k:05d}") for k in range(count)]


def _turned(camera: Camera, scene: Scene, point: npt.NDArray[np.float64], turns: float, name: str) -> Camera:
    """A camera moved about the vertical through a point."""
    before_from_now = np.eye(4)
    before_from_now[:3, :3] = axis_rotation(scene.up_direction, -2.0 * math.pi * turns)
    before_from_now[:3, 3] = point - before_from_now[:3, :3] @ point
    end = camera.camera_from_world_end
    return replace(
        camera,
        camera_from_world=camera.camera_from_world @ before_from_now,
        camera_from_world_end=None if end is None else end @ before_from_now,
        name=name,
    )
