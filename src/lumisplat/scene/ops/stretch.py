"""Captures that are stretched by different factors along different axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumisplat.constants import SCALE_MIN
from lumisplat.math.arrays import Doubles, read_only_view
from lumisplat.math.rotations import matrices_from_quaternions, quaternions_from_matrices
from lumisplat.scene.gaussians import Gaussians


def stretched(gaussians: Gaussians, stretch: Doubles) -> Gaussians:
    """The Gaussians whose covariances are ``P Sigma P``: each stays an ellipsoid, with other axes.

    Harmonics stay as they are, for a stretch has no rotation.

    Args:
        gaussians: The capture.
        stretch: P, symmetric with positive eigenvalues, shape (3, 3).
    """
    axes = stretch @ (matrices_from_quaternions(gaussians.rotations_wxyz) * gaussians.scales[:, None, :])
    rotations, scales, _ = np.linalg.svd(axes)  # Sigma = A A^T, so that A = U S V^T leaves U S^2 U^T
    rotations[np.linalg.det(rotations) < 0.0, :, 2] *= -1.0
    changed = {
        "means": gaussians.means @ stretch.T,
        "rotations_wxyz": quaternions_from_matrices(rotations),
        "scales": np.maximum(scales, SCALE_MIN),
    }
    if gaussians.normals is not None:
        normals = gaussians.normals @ np.linalg.inv(stretch)
        changed["normals"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return replace(gaussians, **{name: read_only_view(values.astype(np.float32)) for name, values in changed.items()})
