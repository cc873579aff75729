"""What a capture shows of each Gaussian: its radiance, and whether that was too bright for a display."""

from __future__ import annotations

import numpy as np

from lumisplat.constants.delight import ALPHA_LEAST, CLIPPED, LAMP_GAP, LAMPS_MAX, VIEW_DIRECTIONS, VIEW_TILT
from lumisplat.math.arrays import Doubles, Flags, FloatArray, Rows
from lumisplat.math.color import decode_srgb
from lumisplat.math.sh import even_directions
from lumisplat.renderer.ray_queries import RayHits
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.sh_colors import colors_along
from lumisplat.scene.sampling.blue_noise import cross_pairs

BLOCK = 16384
"""Gaussians whose colours from all sides are in memory at once."""


def outgoing_radiance(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """Radiance that Gaussians send to most directions before them, so without highlights, linear, shape (N, 3)."""
    found = np.empty((gaussians.count, 3))
    for first in range(0, gaussians.count, BLOCK):
        rows = np.arange(first, min(first + BLOCK, gaussians.count))
        found[rows] = np.median(radiance_before(gaussians.subset(rows), normals[rows], VIEW_DIRECTIONS), axis=0)
    return found


def radiance_before(gaussians: Gaussians, normals: Doubles, count: int) -> Doubles:
    """Radiance that Gaussians send into directions before them, linear, shape (count, N, 3)."""
    seen: list[FloatArray] = []
    for direction in even_directions(count):
        way = np.where(normals @ direction > 0.0, 1.0, -1.0)[:, None] * direction + VIEW_TILT * normals
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        seen.append(decode_srgb(np.clip(colors_along(gaussians, -way), 0.0, 1.0)))
    return np.array(seen, dtype=np.float64)


def radiance_met(hits: RayHits, alpha: FloatArray | Doubles) -> FloatArray | Doubles:
    """Radiance of what rays meet, linear, without their share that passes it, shape (N, 3); ``alpha`` is the rest."""
    return decode_srgb(np.clip(hits.radiance / np.maximum(alpha, ALPHA_LEAST)[:, None], 0.0, 1.0))


def is_white(gaussians: Gaussians, normals: Doubles) -> Flags:
    """Which Gaussians are as bright as could be captured, seen from before them: they may have been brighter; (N,)."""
    return (colors_along(gaussians, -normals) >= CLIPPED).all(axis=1) & (gaussians.opacities > 0.0)


def lamps_of(gaussians: Gaussians, white: Flags) -> Rows:
    """The group of white Gaussians that each is in, largest first, shape (N,); -1: none, or beyond the last."""
    bright = np.flatnonzero(white)
    groups = np.full(gaussians.count, -1)
    if not bright.size:
        return groups
    means = gaussians.means[bright].astype(np.float64)
    pairs = cross_pairs(means, means, LAMP_GAP * float(np.median(gaussians.scales[bright].max(axis=1))))
    label = np.arange(bright.size)
    while True:  # the lowest number of a group spreads through it
        lowest = label.copy()
        np.minimum.at(lowest, pairs.first, label[pairs.second])
        if (lowest == label).all():
            break
        label = lowest[lowest]
    names, sizes = np.unique(label, return_counts=True)
    for number, name in enumerate(names[np.argsort(-sizes, kind="stable")][:LAMPS_MAX]):
        groups[bright[label == name]] = number
    return groups
