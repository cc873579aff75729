"""Computes the edge-aware smoothness of normals in float64 with SciPy's Sobel filter."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import sobel


def differences(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns differences along rows and columns at inner pixels, shape (H - 2, W - 2, 3) each."""
    along = (np.stack([sobel(image[..., c], axis) for c in range(3)], axis=-1) for axis in (1, 0))
    across, down = (one[1:-1, 1:-1] / 8.0 for one in along)
    return across, down


def smoothness(normals: np.ndarray, color: np.ndarray, weight: np.ndarray) -> float:
    """Returns the sum over pixels of ``first_order_edge_aware_loss`` (code of Gao et al. 2024).

    Edge weights are averaged over the channels.

    Args:
        normals: Blended normals, shape (H, W, 3).
        color: Colours of the training image, shape (H, W, 3).
        weight: Weight of each pixel, shape (H, W).
    """
    total = np.zeros(tuple(n - 2 for n in weight.shape))
    for change, edge in zip(differences(normals), differences(color), strict=True):
        total += np.abs(change).mean(axis=-1) * np.exp(-np.abs(edge)).mean(axis=-1)
    return float((weight[1:-1, 1:-1] * total).sum())
