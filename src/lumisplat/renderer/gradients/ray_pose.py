"""Derivatives by the pose of a camera from those by shifts and turns of its rays.

Rays move with their camera as a rigid body. The equations are in docs/method/gradients.md#pose-of-rays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import cross_matrix
from lumisplat.runtime.buffers import DeviceArray
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import SplatInstance


def pose_of_rays_gradient(motions: DeviceArray, instances: Sequence[SplatInstance], camera: Camera) -> Doubles:
    """Derivatives by the upper rows of ``camera_from_world``, shape (3, 4): those of turns and shifts alone.

    Args:
        motions: By where rays are, of each Gaussian of the scene, ``RayMotion``.
        instances: Those of the scene.
        camera: Whose rays they are.
    """
    table = motions.numpy()
    shift, turn, first = np.zeros(3), np.zeros(3), 0
    for instance in instances:
        rows = table[first : first + instance.gaussians.count]
        first += len(rows)
        rotation, offset = instance.transform[:3, :3] / instance.scale, instance.transform[:3, 3]
        by_shift = rotation @ rows["shift"].sum(axis=0, dtype=np.float64) / instance.scale
        shift += by_shift
        turn += rotation @ rows["turn"].sum(axis=0, dtype=np.float64) + np.cross(offset, by_shift)
    camera_from_world = camera.camera_from_world[:3, :3]
    across = cross_matrix(camera_from_world @ turn)
    return np.column_stack([-0.5 * across @ camera_from_world, -camera_from_world @ shift])
