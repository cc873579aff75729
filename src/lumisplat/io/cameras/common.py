"""Defines what camera formats share: names from images, poses of nodes, and sizes of images from aspect ratios."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import Camera, camera_pose

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr", ".heic")

DEFAULT_SIZE_MAX = (1280, 720)
"""Largest width and height, pixels, of a camera for which no size is given."""


def name_from_image(image: object) -> str:
    """The name of an image file without its folder and extension: `images/0001.png` gives `0001`; other dots stay."""
    name = str(image).replace("\\", "/").rstrip("/").rpartition("/")[2]
    return name[: -len(Path(name).suffix)] if Path(name).suffix.lower() in _IMAGE_SUFFIXES else name


def unique_names(cameras: list[Camera]) -> list[Camera]:
    """The cameras with distinct names: an empty name becomes `frame_00000`, a repeated one gets a number."""
    used: set[str] = set()
    copies: dict[str, int] = {}  # the last number that each name was given, so that many equal ones take no longer
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
    """``camera_from_world`` with our axes, rigid also if the node scales or shears, shape (4, 4).

    Args:
        world_from_node: Shape (4, 4).

    Raises:
        SceneError: The node flattens the camera.
    """
    up, back = world_from_node[:3, 1], world_from_node[:3, 2]
    right = np.cross(up, back)
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(up) * np.linalg.norm(back):
        raise SceneError("is scaled to nothing: its camera has no direction")
    return camera_pose(world_from_node[:3, 3], right / np.linalg.norm(right), -back / np.linalg.norm(back))


def size_of_aspect(aspect: float, width: int | None, height: int | None) -> tuple[int, int]:
    """Width and height, pixels.

    Args:
        aspect: Width by height.
        width: Width that is wanted; None: from the height and the aspect ratio.
        height: Height that is wanted. If both are None, the largest size within 1280 x 720.
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
