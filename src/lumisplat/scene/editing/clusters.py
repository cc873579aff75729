"""Which Gaussians become one: pairs of neighbours that lose least, again and again (docs/adr/0027-decimation.md)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import DECIMATE_COLOR_WEIGHT, DECIMATE_NEIGHBOURS
from lumisplat.math.arrays import Doubles
from lumisplat.scene.editing.moments import Moments, log_determinants, mixture
from lumisplat.scene.editing.morton import morton_codes

DECIMATE_BLOCK = 2**13
"""Pairs whose costs are computed at a time: about 60 doubles for each fit into the cache."""

_Indices = npt.NDArray[np.intp]

_SHIFTS = np.array([0.8191725134, 0.6710436067, 0.5497004779])
"""The R3 sequence: steps of the curve's origin from pass to pass, so that its seams lie elsewhere each time."""


class _Pairs(NamedTuple):
    first: _Indices
    second: _Indices
    costs: Doubles


def clusters(parts: Moments, colors: Doubles, count: int, progress: Callable[[float], None] | None) -> _Indices:
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
        for start in range(0, costs.size, DECIMATE_BLOCK):  # so that what is computed on the way stays in the cache
            block = slice(start, min(start + DECIMATE_BLOCK, costs.size))
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
    merged = mixture(first, second)
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
    merged = mixture(first, second)
    for old, new in zip(parts, merged, strict=True):
        old[..., pairs.first] = new
    share = second.masses / merged.masses
    colors[:, pairs.first] += share * (colors[:, pairs.second] - colors[:, pairs.first])
    return parts, colors
