"""Outward normals of Gaussians that come without normals (docs/method/relighting.md#normals)."""

from __future__ import annotations

from functools import partial

import numpy as np

from lumisplat.config import NormalEstimate, enum_member
from lumisplat.constants import NORMAL_NEIGHBOURS, NORMAL_NEIGHBOURS_MIN, NORMAL_NEIGHBOURS_PER_CELL
from lumisplat.math.arrays import Doubles, FloatArray, read_only_view
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.axes import shortest_axes
from lumisplat.scene.ops.outward_side import outward_signs
from lumisplat.scene.sampling.blue_noise import Pairs, cross_pairs
from lumisplat.scene.sampling.neighbours import pairs_of_about


def estimate_normals(gaussians: Gaussians, method: NormalEstimate | str = NormalEstimate.AUTO) -> FloatArray:
    """Estimates unit outward normals of a set that is an object seen from outside.

    First an axis is found for each Gaussian, then which of its two directions points outside, to the free space that is
    connected to the set's surroundings (see `outward_signs`). For a room captured from within, outside is behind its
    walls.

    Args:
        gaussians: The set; more opaque Gaussians have more weight.
        method: ``AUTO``: the set's own ``normals`` if it has them, else ``SMALLEST_AXIS``. ``SMALLEST_AXIS``: the axis
            of the smallest scale; for a round Gaussian any of its axes. ``PCA``: the normal of the plane through the
            means around, weighted by opacity and by a Gaussian of distance; the smallest axis where neighbours are too
            few.

    Returns:
        Normals in the set's own space, shape (N, 3), read-only.

    Raises:
        ConfigError: ``method`` is no NormalEstimate, nor the value of one.
        SceneError: The argument is not a set of Gaussians.
    """
    method = enum_member("method", method, NormalEstimate)
    check_argument("estimate_normals", gaussians, Gaussians, "Gaussians")
    if method is NormalEstimate.AUTO and gaussians.normals is not None:
        return gaussians.normals
    axes = shortest_axes(gaussians)
    if method is NormalEstimate.PCA:
        axes = _plane_normals(gaussians, axes)
    signs = outward_signs(gaussians, axes)
    return read_only_view((axes * signs[:, None]).astype(np.float32))


def _plane_normals(gaussians: Gaussians, fallback: Doubles) -> Doubles:
    """Normals, of either sign, of the planes through the means around each Gaussian, shape (N, 3)."""
    within = partial(_pairs_within, gaussians.means)
    pairs, radius = pairs_of_about(NORMAL_NEIGHBOURS, gaussians.means, within)
    means, opacities = gaussians.means.astype(np.float64), gaussians.opacities.astype(np.float64)
    count = gaussians.count
    first, second = pairs.first, pairs.second
    weights = np.exp(-0.5 * (2.0 * pairs.distance.astype(np.float64) / radius) ** 2) * opacities[second]
    step = means[second] - means[first]
    # Moments about the centre of the neighbours, the Gaussian itself (offset 0) included.
    total = np.bincount(first, weights, count) + opacities
    total = np.maximum(total, np.finfo(np.float64).tiny)
    center = np.stack([np.bincount(first, weights * step[:, i], count) for i in range(3)], axis=1) / total[:, None]
    spread = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            moment = np.bincount(first, weights * step[:, i] * step[:, j], count) / total
            spread[:, i, j] = spread[:, j, i] = moment - center[:, i] * center[:, j]
    vectors = np.linalg.eigh(spread)[1][:, :, 0]
    enough = np.bincount(first, minlength=count) >= NORMAL_NEIGHBOURS_MIN
    return np.where(enough[:, None], vectors, fallback)


def _pairs_within(means: FloatArray, radius: float) -> Pairs:
    """Each Gaussian (``first``) with others near it, at most `NORMAL_NEIGHBOURS_PER_CELL` of them per cube."""
    _, cells = np.unique(np.floor(means / radius).astype(np.int64), axis=0, return_inverse=True)
    order = np.argsort(cells.ravel(), kind="stable")
    starts = np.searchsorted(cells.ravel()[order], cells.ravel()[order])
    candidates = np.sort(order[np.arange(len(means)) - starts < NORMAL_NEIGHBOURS_PER_CELL]).astype(np.int32)
    pairs = cross_pairs(means, means[candidates], radius)
    pairs = pairs._replace(second=candidates[pairs.second])
    return pairs.where(pairs.first != pairs.second)
