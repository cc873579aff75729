"""Gradients with respect to the camera pose, from sums over splats or from gradients of rigid ray motions.

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
    """Contribution of one splat instance to the gradient with respect to the camera pose; float64."""

    camera_from_object: Doubles
    """Gradient with respect to the linear part of the camera-from-object matrix, shape (3, 3)."""
    camera_from_object_offset: Doubles
    """Gradient with respect to the translation of the camera-from-object matrix, shape (3,)."""
    eye: Doubles
    """Gradient with respect to the eye position in object space, through view-dependent colour; shape (3,)."""

    @classmethod
    def of(cls, rows: DeviceArray) -> PoseSums:
        """Reads ``PoseGradient`` rows from the device and adds them up."""
        table = rows.numpy()
        return cls(*(table[name].sum(axis=0, dtype=np.float64) for name in cls.__slots__))


def pose_gradient(sums: PoseSums, instance: SplatInstance, camera: Camera) -> Doubles:
    """Converts one instance's PoseSums to the gradient of the upper three rows of ``camera_from_world``, shape (3, 4).

    The instance's camera-from-object matrix is ``camera_from_world @ world_from_object``. The eye is the point that
    ``camera_from_world`` maps to 0.
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
    """Returns the gradient of the upper rows of ``camera_from_world``, (3, 4), from gradients of rigid ray motions.

    The gradient is restricted to rigid motions: the rays move with their camera
    (docs/method/gradients.md#pose-of-rays).

    Args:
        motions: Gradients with respect to rigid motions of the rays, one ``RayMotion`` for each Gaussian of the scene.
        instances: Splat instances of the scene.
        camera: Camera of the rays.
    """
    table = motions.numpy()
    shift, by_rotation_vector, first = np.zeros(3), np.zeros(3), 0
    for instance in instances:
        rows = table[first : first + instance.gaussians.count]
        first += len(rows)
        rotation, offset = instance.transform[:3, :3] / instance.scale, instance.transform[:3, 3]
        by_shift = rotation @ rows["shift"].sum(axis=0, dtype=np.float64) / instance.scale
        shift += by_shift
        by_rotation_vector += rotation @ rows["rotation"].sum(axis=0, dtype=np.float64) + np.cross(offset, by_shift)
    camera_from_world = camera.camera_from_world[:3, :3]
    across = cross_matrix(camera_from_world @ by_rotation_vector)
    return np.column_stack([-0.5 * across @ camera_from_world, -camera_from_world @ shift])
