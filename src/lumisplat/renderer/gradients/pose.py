"""Derivatives by the pose of a camera: from sums over splats, or from shifts and turns of its rays.

The equations are in docs/method/gradients.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import cross_matrix
from lumisplat.runtime.buffers import DeviceArray
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import SplatInstance


@dataclass(frozen=True, slots=True)
class PoseSums:
    """Derivatives by where the camera is, of one instance; float64."""

    camera_from_object: Doubles
    """Shape (3, 3)."""
    camera_from_object_offset: Doubles
    """Shape (3,)."""
    eye: Doubles
    """In object space, shape (3,)."""


def pose_gradient(sums: PoseSums, instance: SplatInstance, camera: Camera) -> Doubles:
    """Derivatives by the upper rows of ``camera_from_world``, shape (3, 4), of what one instance shows.

    Its own matrix is ``camera_from_world @ world_from_object``; the eye is where that of the camera is 0.
    """
    world_from_object = np.asarray(instance.transform, np.float64)
    by_object = np.column_stack([sums.camera_from_object, sums.camera_from_object_offset])
    total = by_object @ world_from_object.T
    by_eye = np.linalg.inv(world_from_object[:3, :3]).T @ sums.eye
    rotation, offset = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    total[:, :3] -= np.outer(offset, by_eye)  # eye = -rotation^T offset
    total[:, 3] -= rotation @ by_eye
    return total


def pose_of_rays_gradient(motions: DeviceArray, instances: Sequence[SplatInstance], camera: Camera) -> Doubles:
    """Derivatives by the upper rows of ``camera_from_world``, shape (3, 4): those of turns and shifts alone.

    Rays move with their camera as a rigid body (docs/method/gradients.md#pose-of-rays).

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
