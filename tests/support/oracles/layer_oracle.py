"""Decides in float64 which Gaussians near a surface block its light (docs/method/shadows.md#layers)."""

from __future__ import annotations

import numpy as np

from lumisplat.device.gaussian.layers import LAYER_COSINE, LAYER_FLATNESS, LAYER_HEIGHT, LAYER_RISE
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.gaussians import Gaussians


def other_layers(
    gaussians: Gaussians, points: np.ndarray, normals: np.ndarray, directions: np.ndarray, near: np.ndarray
) -> np.ndarray:
    """Returns True for each of N Gaussians that is in another layer than the surface that its ray leaves, shape (N,).

    Args:
        gaussians: One Gaussian hit by each ray.
        points: Ray origins, (N, 3).
        normals: Unit normals of the surfaces that the rays leave, (N, 3).
        directions: Unit directions of the rays, (N, 3).
        near: Distance within which Gaussians of the same layer are ignored, (N,).
    """
    scales = np.sort(gaussians.scales.astype(float), axis=1)
    axes = matrices_from_quaternions(gaussians.rotations_wxyz.astype(float))
    rows = np.arange(len(points))
    thin = axes[rows, :, gaussians.scales.argmin(axis=1)]
    away = gaussians.means.astype(float) - points
    height = np.sum(normals * away, axis=1) / near
    beyond = np.maximum(np.abs(np.sum(normals * thin, axis=1)) - LAYER_COSINE, 0.0)
    stands_before = height > LAYER_HEIGHT + LAYER_RISE * beyond
    is_hit_in_front = np.abs(np.sum(thin * away, axis=1)) / near > LAYER_HEIGHT
    if gaussians.normals is not None:
        is_hit_in_front |= np.sum(gaussians.normals.astype(float) * directions, axis=1) < 0.0
    is_flat = scales[:, 0] < LAYER_FLATNESS * scales[:, 1]
    found: np.ndarray = is_flat & stands_before & is_hit_in_front
    return found
