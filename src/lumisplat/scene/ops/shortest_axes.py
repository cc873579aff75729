"""The axis along which each Gaussian is thinnest: the normal of the surface that it lies on."""

from __future__ import annotations

import numpy as np

from lumisplat.math.arrays import Doubles
from lumisplat.math.rotations import matrices_from_quaternions
from lumisplat.scene.gaussians import Gaussians


def shortest_axes(gaussians: Gaussians) -> Doubles:
    """Of either sign, unit, in the set's own space, shape (N, 3); of a round Gaussian the first of its axes."""
    axes = matrices_from_quaternions(gaussians.rotations_wxyz.astype(np.float64))
    return np.take_along_axis(axes, gaussians.scales.argmin(axis=1)[:, None, None], axis=2)[..., 0]
