"""Rays through the pixel centres in world space, from the centre of the lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumisplat.config.checks import is_whole
from lumisplat.constants.parts import WINDOW_STEP
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import Camera, CameraModel


def world_rays(camera: Camera) -> tuple[Doubles, Doubles]:
    """Origins and unit directions of the rays through the pixel centres of frames, world space, shapes (H, W, 3).

    Pixels of a fisheye that have no ray have direction 0. With a rolling shutter each row has its own pose.
    """
    (width, height), (left, top) = camera.image_size, camera.image_corner
    rotation, directions = camera.world_from_camera[:3, :3], camera.ray_directions()
    starts = np.zeros_like(directions)
    if camera.model is CameraModel.ORTHOGRAPHIC:
        starts[..., 0] = (left + np.arange(width) + 0.5 - camera.cx) / camera.fx
        starts[..., 1] = (top + np.arange(height)[:, None] + 0.5 - camera.cy) / camera.fy
    time = ((top + np.arange(height) + 0.5) / camera.height)[:, None, None]
    turn = time * camera.shutter_turn
    moved = camera.eye + time * camera.shutter_motion
    return moved + _rotate(starts @ rotation.T, turn), _rotate(directions @ rotation.T, turn)


def pixel_ray(camera: Camera, x: int, y: int) -> tuple[Doubles, Doubles]:
    """Origin and unit direction of the ray through the centre of a pixel, world space, of shape (1, 3) each.

    Args:
        camera: The camera.
        x: Column of the picture, from 0.
        y: Row of it, from 0.

    Raises:
        SceneError: There is no such pixel, or it has no ray.
    """
    for name, value, count in (("x", x, camera.width), ("y", y, camera.height)):
        if not is_whole(value) or not 0 <= value < count:
            raise SceneError(f"pixel {name} is {value}, expected a whole number from 0 to {count - 1}")
    around = camera_around(camera, x, y)
    left, top = around.image_corner
    origins, directions = world_rays(around)
    if not directions[y - top, x - left].any():
        raise SceneError(f"pixel ({x}, {y}) has no ray: it is outside of what the lens shows")
    return origins[y - top, x - left][None], directions[y - top, x - left][None]


def camera_around(camera: Camera, x: int, y: int) -> Camera:
    """The camera with the smallest window that shows a pixel of the picture."""
    left, top = (side // WINDOW_STEP * WINDOW_STEP for side in (x, y))
    window = left, top, min(WINDOW_STEP, camera.width - left), min(WINDOW_STEP, camera.height - top)
    return replace(camera, window=window)


def _rotate(vectors: Doubles, turn: Doubles) -> Doubles:
    """Rotates vectors about ``turn`` by its length in radians (Rodrigues), shapes (H, W, 3) and (H, 1, 3)."""
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    axis = np.divide(turn, angle, out=np.zeros_like(turn), where=angle > 0.0)
    across = np.cross(axis, vectors)
    return vectors + np.sin(angle) * across + 2.0 * np.sin(0.5 * angle) ** 2 * np.cross(axis, across)
