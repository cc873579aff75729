"""Returns directions: random ones and a quadrature of the sphere."""

from __future__ import annotations

import numpy as np


def unit(seed: int, count: int) -> np.ndarray:
    """Returns random unit vectors, shape (N, 3)."""
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def sphere_quadrature(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns directions (N, 3) and weights (N,) that integrate SH up to degree ``2 order - 1`` exactly."""
    z, weights = np.polynomial.legendre.leggauss(order)
    phi = (np.arange(2 * order) + 0.5) * np.pi / order
    sine = np.sqrt(1.0 - z * z)[:, None]
    directions = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.broadcast_to(z[:, None], (order, 2 * order))], -1)
    return directions.reshape(-1, 3), np.repeat(weights, 2 * order) * np.pi / order
