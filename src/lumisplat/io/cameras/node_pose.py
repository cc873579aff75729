"""Poses of cameras that hang on nodes of a scene, with y up and -z forward, as in glTF and OpenUSD."""

from __future__ import annotations

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles
from lumisplat.scene.camera import camera_pose


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
