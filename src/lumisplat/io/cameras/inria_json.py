"""Cameras of INRIA's `cameras.json`: OpenCV axes, and the principal point in the centre of the image."""

from __future__ import annotations

import numpy as np

from lumisplat.io.cameras.json_values import Entry, inverse_rigid, number, number_array, rigid_pose
from lumisplat.io.cameras.names import name_from_image
from lumisplat.scene.camera import Camera


def inria_camera(entry: Entry) -> Camera:
    """The camera of one entry.

    Raises:
        KeyError: A value is missing.
        SceneError: A value is invalid.
    """
    width, height = number(entry, "width"), number(entry, "height")
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = number_array(entry["rotation"], (3, 3), "rotation")
    world_from_camera[:3, 3] = number_array(entry["position"], (3,), "position")
    return Camera(
        width=width,  # pyright: ignore[reportArgumentType] # Camera refuses what is not a whole number
        height=height,  # pyright: ignore[reportArgumentType]
        fx=number(entry, "fx"),
        fy=number(entry, "fy"),
        cx=0.5 * width,
        cy=0.5 * height,
        camera_from_world=inverse_rigid(rigid_pose(world_from_camera)),
        name=name_from_image(entry.get("img_name", "")),
    )
