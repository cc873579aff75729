"""Code that camera formats share: camera names from image files, node poses, image sizes from aspect ratios."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import Camera, camera_pose

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr", ".heic")

DEFAULT_SIZE_MAX = (1280, 720)
"""Largest width and height, in pixels, that a camera gets if neither the file nor the caller gives its image size."""


def name_from_image(image: object) -> str:
    """Returns an image's file name without folder and image extension: `images/0001.a.png` gives `0001.a`."""
    name = str(image).replace("\\", "/").rstrip("/").rpartition("/")[2]
    return name[: -len(Path(name).suffix)] if Path(name).suffix.lower() in _IMAGE_SUFFIXES else name


def unique_names(cameras: list[Camera]) -> list[Camera]:
    """Gives cameras distinct names: an empty name becomes `frame_00000`, and a repeated one gets a number appended."""
    used: set[str] = set()
    copies: dict[str, int] = {}  # last number appended to each name, so that many equal names stay fast
    named: list[Camera] = []
    for index, camera in enumerate(cameras):
        base = camera.name or f"frame_{index:05d}"
        name = base
        while name in used:
            copies[base] = copies.get(base, 1) + 1
            name = f"{base}_{copies[base]}"
        used.add(name)
        named.append(camera if name == camera.name else replace(camera, name=name))
    return named


def pose_of_node(world_from_node: Doubles) -> Doubles:
    """Converts the transform of a glTF camera node, OpenGL axes, to ``camera_from_world``, OpenCV axes.

    The result is rigid even if the node scales or shears.

    Args:
        world_from_node: Transform of the node, shape (4, 4).

    Returns:
        Pose with OpenCV axes, shape (4, 4).

    Raises:
        SceneError: The node scales the camera's axes to zero.
    """
    up, back = world_from_node[:3, 1], world_from_node[:3, 2]
    right = np.cross(up, back)
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(up) * np.linalg.norm(back):
        raise SceneError("has a scale of zero: its camera has no direction")
    return camera_pose(world_from_node[:3, 3], right / np.linalg.norm(right), -back / np.linalg.norm(back))


def size_of_aspect(aspect: float, width: int | None, height: int | None) -> tuple[int, int]:
    """Returns the width and height of an image, pixels; a size that is not given follows from the aspect ratio.

    Args:
        aspect: Width divided by height.
        width: Wanted width; None derives it from the height.
        height: Wanted height; None derives it from the width. If both are None, the largest size within 1280 x 720.
    """
    if width is None and height is None:
        if aspect >= DEFAULT_SIZE_MAX[0] / DEFAULT_SIZE_MAX[1]:
            width = DEFAULT_SIZE_MAX[0]
        else:
            height = DEFAULT_SIZE_MAX[1]
    if width is None:
        assert height is not None
        width = max(1, round(height * aspect))
    return width, max(1, round(width / aspect)) if height is None else height
