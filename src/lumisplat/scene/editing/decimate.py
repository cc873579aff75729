"""Makes captures of fewer, larger Gaussians that look the same from farther away (docs/adr/0027-decimation.md).

Pairs of neighbours that lose least become one, again and again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SCALE_MIN, SH_C0
from lumisplat.math.arrays import Doubles, read_only_view
from lumisplat.math.transforms import matrices_from_quaternions, quaternions_from_matrices
from lumisplat.scene.checks import check_argument, check_whole
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.neighbours import morton_codes

DECIMATE_NEIGHBOURS = 4
"""Next ones along a Morton curve, in each direction, with which a Gaussian may be merged. More make passes slower, and
merge more where it is cheap, less evenly: 8 are 0.3 dB worse on the biker."""

DECIMATE_COLOR_WEIGHT = 30.0
"""Loss by a difference of colours of 1, relative to that by an e-fold larger spread. Within 0.3 dB from 10 to 100."""

DECIMATE_OPACITY_MIN = 1e-9
"""Opacity below which a Gaussian's mass falls no further: weights must not be 0."""

ROWS, COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
"""Where the six entries of a packed symmetric matrix stand."""

_DECIMATE_BLOCK = 2**13
"""Pairs whose costs are computed at a time: about 60 doubles for each fit into the cache."""

_Indices = npt.NDArray[np.intp]

_SHIFTS = np.array([0.8191725134, 0.6710436067, 0.5497004779])
"""The R3 sequence: steps of the curve's origin from pass to pass, so that its seams lie elsewhere each time."""


class Moments(NamedTuple):
    """Moments of N Gaussians, an array for each axis or entry, so that each is contiguous."""

    masses: Doubles
    """Opacity times `areas`, above 0, shape (N,)."""
    means: Doubles
    """Shape (3, N)."""
    covariances: Doubles
    """Packed, shape (6, N)."""

    def at(self, rows: npt.NDArray[np.intp] | slice) -> Moments:
        """Some of them."""
        return Moments(self.masses[rows], self.means[:, rows], self.covariances[:, rows])


def moments_of(gaussians: Gaussians) -> Moments:
    """The moments of each Gaussian of a capture."""
    axes = matrices_from_quaternions(gaussians.rotations_wxyz) * gaussians.scales[:, None, :].astype(np.float64)
    matrices = axes @ axes.transpose(0, 2, 1)
    covariances = np.ascontiguousarray(matrices[:, ROWS, COLUMNS].T)
    # Invisible ones have some mass, too: they have a position.
    opacities = np.maximum(gaussians.opacities.astype(np.float64), DECIMATE_OPACITY_MIN)
    return Moments(opacities * areas(covariances), np.ascontiguousarray(gaussians.means.T, np.float64), covariances)


def areas(covariances: Doubles) -> Doubles:
    """The area that a Gaussian covers, up to a constant: the root mean square over all directions, shape (N,).

    Seen along a unit vector n, its outline has the area pi sqrt(n^T adj(covariance) n), whose square has a third of the
    adjugate's trace as its mean.
    """
    xx, xy, xz, yy, yz, zz = covariances
    trace = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    return np.sqrt(np.maximum(trace, SCALE_MIN**4))


def log_determinants(covariances: Doubles) -> Doubles:
    """Natural logarithms of the determinants, shape (N,)."""
    xx, xy, xz, yy, yz, zz = covariances
    determinants = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    # Rounding may leave nothing, or less, of the thinnest.
    return np.log(np.maximum(determinants, 1e-15 * xx * yy * zz + SCALE_MIN**6))


def _mixture(first: Moments, second: Moments) -> Moments:
    """The moments of the mixture of each Gaussian of ``first`` with one of ``second``."""
    masses = first.masses + second.masses
    share = second.masses / masses
    step = second.means - first.means
    covariances = first.covariances + share * (second.covariances - first.covariances)
    spread = share * (1.0 - share)
    for entry in range(6):
        covariances[entry] += spread * step[ROWS[entry]] * step[COLUMNS[entry]]
    return Moments(masses, first.means + share * step, covariances)


def mixtures(parts: Moments, labels: npt.NDArray[np.intp], count: int) -> Moments:
    """The moments of ``count`` mixtures, to which the labels of the parts, shape (N,), assign them."""
    masses = np.bincount(labels, parts.masses, count).astype(np.float64, copy=False)

    def averages(values: Doubles) -> Doubles:
        return np.stack([np.bincount(labels, parts.masses * row, count) / masses for row in values])

    means = averages(parts.means)
    offsets = parts.means - means[:, labels]
    products = parts.covariances + offsets[list(ROWS)] * offsets[list(COLUMNS)]
    return Moments(masses, means, averages(products))


def shapes(covariances: Doubles) -> tuple[Doubles, Doubles]:
    """Unit quaternions, shape (N, 4), and scales, the smallest first, shape (N, 3), of covariances."""
    matrices = np.empty((covariances.shape[1], 3, 3))
    for entry in range(6):
        matrices[:, ROWS[entry], COLUMNS[entry]] = matrices[:, COLUMNS[entry], ROWS[entry]] = covariances[entry]
    variances, axes = np.linalg.eigh(matrices)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    # Rounding hides variances below 1e-16 of the largest.
    smallest = np.maximum(SCALE_MIN**2, 1e-15 * variances[:, 2:])
    return quaternions_from_matrices(axes).astype(np.float64), np.sqrt(np.maximum(variances, smallest))


class _Pairs(NamedTuple):
    first: _Indices
    second: _Indices
    costs: Doubles


def _clusters(parts: Moments, colors: Doubles, count: int, progress: Callable[[float], None] | None) -> _Indices:
    """Assigns Gaussians to ``count`` clusters.

    Args:
        parts: Their moments, of N Gaussians.
        colors: Their display-referred mean colours, shape (3, N).
        count: Number of clusters, 1..N.
        progress: Called with the fraction done, 0..1.

    Returns:
        The cluster of each, 0..count - 1, along a Morton curve, shape (N,).
    """
    labels = np.arange(parts.masses.size)
    start = max(math.log(parts.masses.size / count), 1e-9)
    step = 0
    while parts.masses.size > count:
        order = _curve(parts.means, step)
        parts, colors = parts.at(order), colors[:, order]
        pairs = _cheapest(_mutual_pairs(parts, colors), parts.masses.size - count)
        into = np.arange(order.size)
        into[pairs.second] = pairs.first
        kept = np.flatnonzero(into == np.arange(order.size))
        place = np.empty(order.size, np.intp)
        place[kept] = np.arange(kept.size)
        rank = np.empty(order.size, np.intp)
        rank[order] = place[into]
        labels = rank[labels]
        parts, colors = _merged(parts, colors, pairs)
        parts, colors = parts.at(kept), colors[:, kept]
        step += 1
        if progress:
            progress(min(1.0 - math.log(parts.masses.size / count) / start, 1.0))
    return labels


def _curve(means: Doubles, step: int) -> _Indices:
    """The order of the means along a Morton curve of cubic cells, whose origin is another in each step."""
    low, high = np.quantile(means, (0.001, 0.999), axis=1)
    extent = max(float((high - low).max()), np.finfo(np.float32).tiny)
    # The capture fills half of the cube in each direction, and is moved within it.
    shares = 0.5 * (means - low[:, None]) / extent + 0.5 * ((step * _SHIFTS) % 1.0)[:, None]
    return np.argsort(morton_codes(np.clip(shares, 0.0, 1.0)), kind="stable")


def _mutual_pairs(parts: Moments, colors: Doubles) -> _Pairs:
    """Pairs of which each is the other's cheapest among the nearest along the curve."""
    count = parts.masses.size
    numbers = np.arange(count)
    best, partner = np.full(count, np.inf), np.full(count, -1, np.intp)
    logs = log_determinants(parts.covariances)
    for apart in range(1, min(DECIMATE_NEIGHBOURS, count - 1) + 1):
        costs = np.empty(count - apart)
        for start in range(0, costs.size, _DECIMATE_BLOCK):  # so that what is computed on the way stays in the cache
            block = slice(start, min(start + _DECIMATE_BLOCK, costs.size))
            costs[block] = _costs(parts, logs, colors, block, slice(block.start + apart, block.stop + apart))
        # Costs that are equal, as of copies, must not all point the same way along the curve: few would be mutual.
        ties = (numbers[: costs.size] * 0.6180339887 + apart * 0.4142135624) % 1.0
        costs += 1e-9 * np.sqrt(parts.masses[: costs.size]) * ties
        here, there = slice(0, count - apart), slice(apart, count)
        for own, other in ((here, there), (there, here)):
            better = costs < best[own]
            np.copyto(best[own], costs, where=better)
            np.copyto(partner[own], numbers[other], where=better)
    first = np.flatnonzero((partner[partner] == numbers) & (partner > numbers))
    return _Pairs(first, partner[first], best[first])


def _costs(parts: Moments, logs: Doubles, colors: Doubles, own: slice, other: slice) -> Doubles:
    """What is lost by merging each Gaussian of a slice with one of the other slice."""
    first, second = parts.at(own), parts.at(other)
    merged = _mixture(first, second)
    # Runnalls 2007, equation 16: a bound of how much less likely the mixture becomes, in shape.
    shape = (
        merged.masses * log_determinants(merged.covariances) - first.masses * logs[own] - second.masses * logs[other]
    )
    color = ((colors[:, own] - colors[:, other]) ** 2).sum(axis=0)
    spread = first.masses * second.masses / merged.masses
    # Over the root of the mass: between the loss as a whole, which spares the large, and that for each unit of mass.
    return (0.5 * shape + DECIMATE_COLOR_WEIGHT * spread * color) / np.sqrt(merged.masses)


def _cheapest(pairs: _Pairs, most: int) -> _Pairs:
    """At most ``most`` of the pairs, the cheapest."""
    if pairs.first.size <= most:
        return pairs
    rows = np.argpartition(pairs.costs, most - 1)[:most]
    return _Pairs(pairs.first[rows], pairs.second[rows], pairs.costs[rows])


def _merged(parts: Moments, colors: Doubles, pairs: _Pairs) -> tuple[Moments, Doubles]:
    """Moments and colours in which the first of each pair has become the mixture of both."""
    first, second = parts.at(pairs.first), parts.at(pairs.second)
    merged = _mixture(first, second)
    for old, new in zip(parts, merged, strict=True):
        old[..., pairs.first] = new
    share = second.masses / merged.masses
    colors[:, pairs.first] += share * (colors[:, pairs.second] - colors[:, pairs.first])
    return parts, colors


def decimate(gaussians: Gaussians, count: int, *, progress: Callable[[float], None] | None = None) -> Gaussians:
    """Merges neighbours until ``count`` Gaussians are left.

    Each new Gaussian has the mean and the covariance of those that it stands for, and their mass: opacity times the
    area that they cover, averaged over all directions, so that it hides as much of what is behind it (up to opacity 1).
    Harmonics, normals and materials are means weighted by mass.

    Args:
        gaussians: The capture, of N Gaussians.
        count: How many are left, 1 or more: ``len(gaussians) // 4`` for a quarter.
        progress: Called with the fraction done, 0..1.

    Returns:
        New Gaussians along a Morton curve; ``gaussians`` itself if it has no more than ``count``.

    Raises:
        SceneError: ``count`` is no whole number above 0.
    """
    check_argument("decimate", gaussians, Gaussians, "Gaussians")
    check_whole("count", count, 1, 2**31)
    if gaussians.count <= count:
        return gaussians
    parts = moments_of(gaussians)
    colors = np.clip(SH_C0 * gaussians.sh[:, 0].T.astype(np.float64) + 0.5, 0.0, 1.0)
    labels = _clusters(parts, colors, count, progress)
    merged = mixtures(parts, labels, count)
    rotations, scales = shapes(merged.covariances)

    def averages(values: npt.NDArray[np.floating]) -> Doubles:
        rows = values.reshape(gaussians.count, -1).T
        sums = [np.bincount(labels, parts.masses * row, count) for row in rows]
        return (np.stack(sums, axis=1) / merged.masses[:, None]).reshape(count, *values.shape[1:])

    changed = {name: averages(values) for name, values in gaussians.arrays().items()} | {
        "means": merged.means.T,
        "rotations_wxyz": rotations,
        "scales": scales,
        "opacities": np.clip(merged.masses / areas(merged.covariances), 0.0, 1.0),
    }
    if "normals" in changed:
        changed["normals"] = _unit_or_thin_axis(changed["normals"], rotations)
    float32 = {name: np.ascontiguousarray(values, np.float32) for name, values in changed.items()}
    return replace(gaussians, **{name: read_only_view(values) for name, values in float32.items()})


def _unit_or_thin_axis(normals: Doubles, rotations: Doubles) -> Doubles:
    """Mean normals made unit; the thinnest axis, which is the first, where they cancel."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    thin = matrices_from_quaternions(rotations)[:, :, 0]
    return np.where(lengths > 1e-3, normals / np.maximum(lengths, 1e-3), thin)
