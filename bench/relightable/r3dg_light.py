"""Directions, visibility and the environment map as Relightable 3D Gaussians (Gao et al. 2024) have them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

import lumisplat as ls
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.training.materials.lit_gaussians import ray_starts

HEIGHT, WIDTH = 16, 32
"""Of their environment map."""
LEAST_SINE = np.sin(np.radians(10.0))
"""Of the elevation of directions: lower ones are put up to it."""
BLOCKED = 0.9
"""Transmittance below which a direction counts as blocked."""


def hemispheres(normals: Doubles, count: int, rng: np.random.Generator) -> Doubles:
    """Fibonacci points over the hemisphere of each normal, each turned about it by chance, shape (N, count, 3)."""
    index = np.arange(count)
    z = np.maximum(1.0 - 2.0 * index / (2.0 * count - 1.0), LEAST_SINE)
    angle = np.pi * (3.0 - np.sqrt(5.0)) * index + 2.0 * np.pi * rng.random((len(normals), 1))
    radius = np.sqrt(1.0 - z * z)
    local = np.stack([np.cos(angle) * radius, np.sin(angle) * radius, np.broadcast_to(z, angle.shape)], axis=-1)
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(helper, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normals, first), normals], axis=1)
    return np.einsum("nsk,nkc->nsc", local, frames)


def visibility(gaussians: ls.Gaussians, normals: Doubles, ways: Doubles, device: str) -> FloatArray:
    """Their rule, by our rays: transmittance, and 0 where it is below 0.9; shape (N, S)."""
    count = ways.shape[1]
    starts = np.repeat(ray_starts(gaussians, normals), count, axis=0)
    scene = ls.Scene([gaussians])
    left = ls.transmittance(scene, starts, ways.reshape(-1, 3), np.inf, device=device)
    return np.where(left < BLOCKED, 0.0, left).reshape(-1, count).astype(np.float32)


@dataclass(frozen=True)
class Lookups:
    """Bilinear lookups in their map along directions, whose corners are the middles of its outermost pixels."""

    matrix: sparse.csr_matrix
    """Shape (directions, 512)."""

    @classmethod
    def of(cls, ways: Doubles, weights: FloatArray) -> Lookups:
        """Along directions, shape (M, 3), each times a weight, shape (M,)."""
        down = np.clip(np.arccos(np.clip(ways[:, 2], -1.0, 1.0)) / np.pi, 0.0, 1.0) * (HEIGHT - 1)
        across = (0.5 - 0.5 * np.arctan2(ways[:, 1], ways[:, 0]) / np.pi) * (WIDTH - 1)
        top, left = np.minimum(down.astype(int), HEIGHT - 2), np.minimum(across.astype(int), WIDTH - 2)
        below, right = down - top, across - left
        shares = [(1 - below) * (1 - right), (1 - below) * right, below * (1 - right), below * right]
        corner = top * WIDTH + left
        columns = np.stack([corner, corner + 1, corner + WIDTH, corner + WIDTH + 1], axis=1)
        values = np.stack(shares, axis=1) * weights[:, None]
        starts = np.arange(0, 4 * len(ways) + 1, 4)
        shape = (len(ways), HEIGHT * WIDTH)
        return cls(sparse.csr_matrix((values.ravel().astype(np.float32), columns.ravel(), starts), shape=shape))


def softplus(raw: Doubles) -> Doubles:
    """Of any number, positive."""
    return np.logaddexp(0.0, raw)


def softplus_slope(raw: Doubles) -> Doubles:
    """Its derivative."""
    return 1.0 / (1.0 + np.exp(-raw))


def roughness_gradient(sky: Doubles) -> Doubles:
    """Derivatives of the mean squared differences between neighbours of a map, shape (512, 3)."""
    image, total = sky.reshape(HEIGHT, WIDTH, 3), np.zeros((HEIGHT, WIDTH, 3))
    for axis in (0, 1):
        steps = np.diff(image, axis=axis)
        given = 2.0 * steps / steps.size
        after, before = [slice(None)] * 3, [slice(None)] * 3
        after[axis], before[axis] = slice(1, None), slice(None, -1)
        total[tuple(after)] += given
        total[tuple(before)] -= given
    return total.reshape(-1, 3)


def greyness_gradient(light: Doubles) -> Doubles:
    """Derivatives of the mean distance of light from grey, shape (N, 3)."""
    sides = np.sign(light - light.mean(axis=1, keepdims=True))
    return (sides - sides.mean(axis=1, keepdims=True)) / light.size
