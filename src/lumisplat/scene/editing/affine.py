"""Captures under any affine transform: files scale them by factors that differ along the axes, as instances do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumisplat.constants import SCALE_MIN
from lumisplat.math.arrays import Doubles, matrix_4x4, read_only_view
from lumisplat.math.transforms import matrices_from_quaternions, quaternions_from_matrices, transform_points
from lumisplat.scene.editing.transform import turned_harmonics
from lumisplat.scene.gaussians import Gaussians, moved_orientation

_BLOCK = 2**16
"""Gaussians whose axes are found at once."""


def under_affine(gaussians: Gaussians, matrix: Doubles) -> Gaussians:
    """The Gaussians with their shapes moved, turned, stretched, sheared and mirrored; opacities and materials stay.

    A covariance ``C C^T`` with ``C = R S`` becomes ``M C (M C)^T``, whose principal axes are the left singular vectors
    of ``M C``. Colours turn, and are mirrored, with the rotation nearest to M, its orthogonal polar factor: harmonics
    cannot be stretched.

    Args:
        gaussians: The capture.
        matrix: ``new_from_old``, shape (4, 4).

    Raises:
        SceneError: The matrix is not finite or singular, or a result is too large.
    """
    new_from_old = matrix_4x4("matrix", matrix)
    linear = new_from_old[:3, :3]
    left, _, right = np.linalg.svd(linear)
    turn = left @ right
    rotations, scales = np.empty((gaussians.count, 4)), np.empty((gaussians.count, 3))
    for start in range(0, gaussians.count, _BLOCK):
        rows = slice(start, start + _BLOCK)
        axes = matrices_from_quaternions(gaussians.rotations_wxyz[rows].astype(np.float64))
        axes = linear @ (axes * gaussians.scales[rows, None, :].astype(np.float64))
        turned, scales[rows], _ = np.linalg.svd(axes)
        turned[:, :, 2] *= np.sign(np.linalg.det(turned))[:, None]
        rotations[rows] = quaternions_from_matrices(turned)
    changed = {
        "means": transform_points(new_from_old, gaussians.means),
        "rotations_wxyz": rotations,
        "scales": np.maximum(scales, SCALE_MIN),
        "sh": turned_harmonics(gaussians.sh, turn),
    }
    if gaussians.incident is not None:
        changed["incident"] = turned_harmonics(gaussians.incident, turn)
    if gaussians.normals is not None:
        changed["normals"] = gaussians.normals @ np.linalg.inv(linear)  # rows, so that this is the inverse transpose
    with np.errstate(over="ignore", under="ignore"):  # what is too large is refused
        arrays = {name: read_only_view(v.astype(np.float32)) for name, v in changed.items()}
        return replace(gaussians, **arrays, **moved_orientation(gaussians, new_from_old))
