"""Cameras focused on what one of their pixels shows."""

from __future__ import annotations

import math
from dataclasses import replace

from lumisplat.errors import SceneError
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.ops.pixel_rays import camera_around


def focused_camera(camera: Camera, x: int, y: int, distance: float) -> Camera:
    """The camera with what pixel (x, y) shows in focus.

    Args:
        camera: The camera.
        x: Column of the picture, from 0.
        y: Row of it, from 0.
        distance: To the surface along the ray of the pixel's centre, scene units; inf: there is none.

    Raises:
        SceneError: There is no surface in front of the camera.
    """
    depth = distance
    if camera.model is not CameraModel.FISHEYE:
        around = camera_around(camera, x, y)
        left, top = around.image_corner
        depth = distance * float(around.ray_directions()[y - top, x - left, 2])
    if not 0.0 < depth < math.inf:
        raise SceneError(f"pixel ({x}, {y}) shows no surface to focus on: pick another one, or give focus_distance")
    return replace(camera, focus_distance=depth)
