"""Axes of Gaussians: the shortest, which is the normal of the surface that each lies on, and the two others."""

from __future__ import annotations

import numpy as np

from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.gaussians import Gaussians


def shortest_axes(gaussians: Gaussians) -> Doubles:
    """Of either sign, unit, in the set's own space, shape (N, 3); of a round Gaussian the first of its axes."""
    return _ranked_axes(gaussians)[..., 0]


def wide_axes(gaussians: Gaussians) -> tuple[Doubles, Doubles]:
    """The two others, each times its scale, the shorter ones first, shape (N, 3) both."""
    axes, scales = _ranked_axes(gaussians), np.sort(gaussians.scales, axis=1)
    return axes[..., 1] * scales[:, 1:2], axes[..., 2] * scales[:, 2:]


def _ranked_axes(gaussians: Gaussians) -> Doubles:
    """The axes as columns, from the one with the least scale to that with the largest, unit, shape (N, 3, 3)."""
    axes = matrices_from_quaternions(gaussians.rotations_wxyz.astype(np.float64))
    order = np.argsort(gaussians.scales, axis=1, kind="stable")
    return np.take_along_axis(axes, order[:, None, :], axis=2)
