"""Which Gaussians of a capture were too bright for a display, and so may be lamps."""

from __future__ import annotations

import numpy as np

from lumisplat.constants.delight import CLIPPED, LAMP_GAP, LAMPS_MAX
from lumisplat.math.arrays import Doubles, Flags, Rows
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import colors_along
from lumisplat.scene.sampling.blue_noise import cross_pairs


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
