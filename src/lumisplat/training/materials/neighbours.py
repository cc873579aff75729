"""The nearest neighbours of Gaussians."""

from __future__ import annotations

import numpy as np

from lumisplat.constants.materials import CURVE_REACH, CURVE_SHIFTS, NEIGHBOURS
from lumisplat.math.arrays import Doubles, FloatArray, Rows
from lumisplat.scene.editing.morton import morton_codes
from lumisplat.training.materials.alike_pairs import AlikePairs

BLOCK = 8192
"""Gaussians whose neighbours are looked for at once."""


def near_pairs(means: FloatArray) -> AlikePairs:
    """Each Gaussian with the nearest of those that are near it along Morton curves."""
    count = len(means)
    points, most = means.astype(np.float64), min(NEIGHBOURS, count - 1)
    orders = [_along_curve(points, shift) for shift in CURVE_SHIFTS]
    places = [np.argsort(order, kind="stable") for order in orders]
    near = np.empty((count, most), np.int64)
    for first in range(0, count, BLOCK):
        rows = np.arange(first, min(first + BLOCK, count))
        others = np.concatenate(
            [_beside(order, place[rows]) for order, place in zip(orders, places, strict=True)], axis=1
        )
        near[rows] = _nearest(points, rows, others, most)
    return AlikePairs(np.repeat(np.arange(count), most), near.ravel())


def _along_curve(points: Doubles, shift: float) -> Rows:
    """The order of points along a Morton curve whose cells are cubes, and end elsewhere by a share of the whole."""
    low, high = np.quantile(points, (0.001, 0.999), axis=0)
    shares = np.clip((points - low) / max(float((high - low).max()), 1e-30), 0.0, 1.0)
    return np.argsort(morton_codes(((shares + shift) / (1.0 + shift)).T), kind="stable")


def _beside(order: Rows, places: Rows) -> Rows:
    """What stands beside places of an order, (n, 2 * CURVE_REACH); beyond its ends, what stands there."""
    offsets = np.concatenate([np.arange(-CURVE_REACH, 0), np.arange(1, CURVE_REACH + 1)])
    return order[np.clip(places[:, None] + offsets, 0, len(order) - 1)]


def _nearest(points: Doubles, rows: Rows, others: Rows, most: int) -> Rows:
    """The nearest of some others of each row, each once and not the row itself, (n, most)."""
    others = np.sort(others, axis=1)
    squares = np.square(points[others] - points[rows, None]).sum(axis=2)
    squares[others == rows[:, None]] = np.inf
    squares[:, 1:][others[:, 1:] == others[:, :-1]] = np.inf
    return np.take_along_axis(others, np.argsort(squares, axis=1, kind="stable")[:, :most], axis=1)
