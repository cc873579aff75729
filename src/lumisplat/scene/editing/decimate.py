"""Decimation: captures with fewer, larger Gaussians that look the same from a distance.

Each pass merges the pairs of neighbouring Gaussians with the least cost (docs/adr/0027-decimation-by-merging.md).
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
"""Number of next Gaussians along the Morton curve, in each direction, with which a Gaussian may merge. Larger numbers
make passes slower and concentrate merging where merging is cheap: 8 are 0.3 dB worse on a capture of a biker.
"""

DECIMATE_COLOR_WEIGHT = 30.0
"""Weight of colour against shape in the cost of merging two Gaussians: factor on the squared difference of their
display colours, which is added to the growth of their covariance. Results stay within 0.3 dB from 10 to 100."""

DECIMATE_OPACITY_MIN = 1e-9
"""Opacities are raised to at least this before the masses (mixture weights) of Gaussians are computed: no mass may be
0."""

ROWS, COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
"""Row (`ROWS`) and column (`COLUMNS`) in a symmetric 3 x 3 matrix of its six packed entries xx, xy, xz, yy, yz, zz."""

_DECIMATE_BLOCK = 2**13
"""Number of pairs whose merging costs are computed at once: about 60 doubles per pair fit into the CPU cache."""

_Indices = npt.NDArray[np.intp]

_SHIFTS = np.array([0.8191725134, 0.6710436067, 0.5497004779])
"""Offset of the Morton curve's origin along x, y, z per pass (R3 sequence), so that cell borders do not separate the
same neighbours in all passes."""


class Moments(NamedTuple):
    """Mass (opacity times area), mean and covariance of N Gaussians, axis by axis in contiguous arrays."""

    masses: Doubles
    """Weight of each Gaussian in mixtures: opacity times projected area (`areas`), above 0, shape (N,)."""
    means: Doubles
    """Centres of the N Gaussians, scene units, shape (3, N)."""
    covariances: Doubles
    """Covariances as six packed entries xx, xy, xz, yy, yz, zz, square scene units, shape (6, N)."""

    def at(self, rows: npt.NDArray[np.intp] | slice) -> Moments:
        """Returns mass, mean and covariance of the Gaussians that ``rows`` (indices or a slice) selects."""
        return Moments(self.masses[rows], self.means[:, rows], self.covariances[:, rows])


def moments_of(gaussians: Gaussians) -> Moments:
    """Returns mass (opacity times projected area), mean and covariance of each Gaussian of a capture."""
    axes = matrices_from_quaternions(gaussians.rotations_wxyz) * gaussians.scales[:, None, :].astype(np.float64)
    matrices = axes @ axes.transpose(0, 2, 1)
    covariances = np.ascontiguousarray(matrices[:, ROWS, COLUMNS].T)
    # Invisible Gaussians keep a little mass, so that their mixture has a position.
    opacities = np.maximum(gaussians.opacities.astype(np.float64), DECIMATE_OPACITY_MIN)
    return Moments(opacities * areas(covariances), np.ascontiguousarray(gaussians.means.T, np.float64), covariances)


def areas(covariances: Doubles) -> Doubles:
    """Returns the projected area of N Gaussians, root mean square over all views, up to a constant factor, (N,).

    Seen along a unit vector n, a Gaussian's outline has the area pi sqrt(n^T adj(covariance) n). The mean of the
    squared area over all n is pi^2 / 3 times the adjugate's trace.
    """
    xx, xy, xz, yy, yz, zz = covariances
    trace = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    return np.sqrt(np.maximum(trace, SCALE_MIN**4))


def log_determinants(covariances: Doubles) -> Doubles:
    """Returns the natural logarithms of N covariances' determinants, shape (N,)."""
    xx, xy, xz, yy, yz, zz = covariances
    determinants = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    # Rounding may make the determinants of the thinnest zero or negative.
    return np.log(np.maximum(determinants, 1e-15 * xx * yy * zz + SCALE_MIN**6))


def _mixture(first: Moments, second: Moments) -> Moments:
    """Returns N mixtures: mass, mean and covariance of Gaussian k of ``first`` and Gaussian k of ``second``."""
    masses = first.masses + second.masses
    share = second.masses / masses
    step = second.means - first.means
    covariances = first.covariances + share * (second.covariances - first.covariances)
    spread = share * (1.0 - share)
    for entry in range(6):
        covariances[entry] += spread * step[ROWS[entry]] * step[COLUMNS[entry]]
    return Moments(masses, first.means + share * step, covariances)


def mixtures(parts: Moments, labels: npt.NDArray[np.intp], count: int) -> Moments:
    """Returns mass, mean and covariance of ``count`` mixtures; ``labels``, (N,), assign N Gaussians to them."""
    masses = np.bincount(labels, parts.masses, count).astype(np.float64, copy=False)

    def averages(values: Doubles) -> Doubles:
        return np.stack([np.bincount(labels, parts.masses * row, count) / masses for row in values])

    means = averages(parts.means)
    offsets = parts.means - means[:, labels]
    products = parts.covariances + offsets[list(ROWS)] * offsets[list(COLUMNS)]
    return Moments(masses, means, averages(products))


def shapes(covariances: Doubles) -> tuple[Doubles, Doubles]:
    """Decomposes N covariances into unit quaternions, shape (N, 4), and scales, smallest first, shape (N, 3)."""
    matrices = np.empty((covariances.shape[1], 3, 3))
    for entry in range(6):
        matrices[:, ROWS[entry], COLUMNS[entry]] = matrices[:, COLUMNS[entry], ROWS[entry]] = covariances[entry]
    variances, axes = np.linalg.eigh(matrices)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    # Variances below 1e-16 of the largest are rounding.
    smallest = np.maximum(SCALE_MIN**2, 1e-15 * variances[:, 2:])
    return quaternions_from_matrices(axes).astype(np.float64), np.sqrt(np.maximum(variances, smallest))


class _Pairs(NamedTuple):
    first: _Indices
    second: _Indices
    costs: Doubles


def _clusters(parts: Moments, colors: Doubles, count: int, progress: Callable[[float], None] | None) -> _Indices:
    """Assigns N Gaussians to ``count`` clusters, each to become one Gaussian, by repeated merging of pairs.

    Args:
        parts: Moments of the Gaussians.
        colors: Display-referred mean colours of the Gaussians, shape (3, N).
        count: Number of clusters, 1..N.
        progress: Called with the fraction done, 0..1.

    Returns:
        Index of each Gaussian's cluster, 0..count - 1, shape (N,). Clusters are numbered along a Morton curve.
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
    """Returns the order of means, (3, N), along a Morton curve whose origin depends on the pass number ``step``."""
    low, high = np.quantile(means, (0.001, 0.999), axis=1)
    extent = max(float((high - low).max()), np.finfo(np.float32).tiny)
    # The capture fills half of the cube along each axis, and shifts within it from pass to pass.
    shares = 0.5 * (means - low[:, None]) / extent + 0.5 * ((step * _SHIFTS) % 1.0)[:, None]
    return np.argsort(morton_codes(np.clip(shares, 0.0, 1.0)), kind="stable")


def _mutual_pairs(parts: Moments, colors: Doubles) -> _Pairs:
    """Returns pairs of Gaussians that are each other's cheapest partner; ``parts`` are sorted along a Morton curve."""
    count = parts.masses.size
    numbers = np.arange(count)
    best, partner = np.full(count, np.inf), np.full(count, -1, np.intp)
    logs = log_determinants(parts.covariances)
    for apart in range(1, min(DECIMATE_NEIGHBOURS, count - 1) + 1):
        costs = np.empty(count - apart)
        for start in range(0, costs.size, _DECIMATE_BLOCK):  # keeps intermediate results in the cache
            block = slice(start, min(start + _DECIMATE_BLOCK, costs.size))
            costs[block] = _costs(parts, logs, colors, block, slice(block.start + apart, block.stop + apart))
        # Equal costs, as of copies, get a tie-breaker: otherwise all choose the same side, and few pairs are mutual.
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
    """Returns the cost of merging Gaussian k of the slice ``own`` with Gaussian k of the slice ``other``.

    The cost grows with the pair's covariance and colour difference. ``logs`` are the logarithms of the determinants of
    the N covariances.
    """
    first, second = parts.at(own), parts.at(other)
    merged = _mixture(first, second)
    # Runnalls 2007, equation 16: upper bound of the Kullback-Leibler divergence of shapes, times the mass.
    shape = (
        merged.masses * log_determinants(merged.covariances) - first.masses * logs[own] - second.masses * logs[other]
    )
    color = ((colors[:, own] - colors[:, other]) ** 2).sum(axis=0)
    spread = first.masses * second.masses / merged.masses
    # Divided by the root of the mass: a compromise between total loss, which spares large Gaussians, and loss per mass.
    return (0.5 * shape + DECIMATE_COLOR_WEIGHT * spread * color) / np.sqrt(merged.masses)


def _cheapest(pairs: _Pairs, most: int) -> _Pairs:
    """Returns the ``most`` pairs of lowest merging cost, in any order; all pairs if there are fewer."""
    if pairs.first.size <= most:
        return pairs
    rows = np.argpartition(pairs.costs, most - 1)[:most]
    return _Pairs(pairs.first[rows], pairs.second[rows], pairs.costs[rows])


def _merged(parts: Moments, colors: Doubles, pairs: _Pairs) -> tuple[Moments, Doubles]:
    """Overwrites the first Gaussian of each pair with the moments and colour of the pair's mixture, in place."""
    first, second = parts.at(pairs.first), parts.at(pairs.second)
    merged = _mixture(first, second)
    for old, new in zip(parts, merged, strict=True):
        old[..., pairs.first] = new
    share = second.masses / merged.masses
    colors[:, pairs.first] += share * (colors[:, pairs.second] - colors[:, pairs.first])
    return parts, colors


def decimate(gaussians: Gaussians, count: int, *, progress: Callable[[float], None] | None = None) -> Gaussians:
    """Merges neighbouring Gaussians until ``count`` are left.

    Each new Gaussian has the mean, the covariance and the mass of the Gaussians that it replaces. The mass is opacity
    times projected area, averaged over all directions; the new Gaussian thus hides as much of the background as the
    replaced ones (up to opacity 1). SH coefficients, normals and materials are averages weighted by mass.

    Args:
        gaussians: Capture of N Gaussians.
        count: Number of Gaussians to keep, 1 or more: ``len(gaussians) // 4`` for a quarter.
        progress: Called with the fraction done, 0..1.

    Returns:
        New Gaussians in Morton order; ``gaussians`` itself if it has at most ``count`` Gaussians.

    Raises:
        SceneError: ``count`` is not a whole number above 0.
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
    """Normalises averaged normals, (N, 3); those of length 0 become the Gaussian's first axis, its thinnest."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    thin = matrices_from_quaternions(rotations)[:, :, 0]
    return np.where(lengths > 1e-3, normals / np.maximum(lengths, 1e-3), thin)
