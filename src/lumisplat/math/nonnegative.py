"""Least squares whose unknowns obey inequalities: the active-set method of Lawson and Hanson (1974, chapter 23).

All from the normal equations: what is fitted has many rows, and few unknowns.
"""

from __future__ import annotations

import numpy as np

from lumisplat.constants.light_fit import ACTIVE_SET_RIDGE, ACTIVE_SET_TOLERANCE
from lumisplat.math.arrays import Doubles, Flags


def nonnegative_least_squares(gram: Doubles, moments: Doubles) -> Doubles:
    """The x of at least 0 that minimises ``x^T G x / 2 - m^T x``; with ``G = A^T A`` and ``m = A^T y``, ``|A x - y|``.

    Unknowns are freed one by one, the steepest first, and held at 0 again where the free ones' minimum would make them
    negative.

    Args:
        gram: G, symmetric, positive semidefinite, shape (n, n).
        moments: m, shape (n,).

    Returns:
        Shape (n,); unknowns that are held are exactly 0.
    """
    count = len(moments)
    x, free = np.zeros(count), np.zeros(count, np.bool_)
    least = ACTIVE_SET_TOLERANCE * max(float(np.abs(moments).max(initial=0.0)), np.finfo(float).tiny)
    for _ in range(3 * count + 1):
        slope = np.where(free, -np.inf, moments - gram @ x)
        steepest = int(slope.argmax()) if count else 0
        if not count or slope[steepest] <= least:
            break
        free[steepest] = True
        x = _minimum_of_free(gram, moments, x, free)
    return x


def bounded_least_squares(gram: Doubles, moments: Doubles, bounded: Doubles, least: Doubles) -> Doubles:
    """The x with ``B x >= b`` that minimises ``x^T G x / 2 - m^T x``, by its dual, which is a non-negative problem.

    With multipliers s of at least 0, the minimum is at ``x = G^-1 (m + B^T s)``, and s minimises
    ``s^T (B G^-1 B^T) s / 2 - (b - B G^-1 m)^T s``.

    Args:
        gram: G, symmetric, positive definite, shape (n, n).
        moments: m, shape (n,).
        bounded: B, shape (k, n).
        least: b, shape (k,); some x satisfies all of them.

    Returns:
        Shape (n,); inequalities hold to rounding.
    """
    free: Doubles = np.asarray(np.linalg.solve(gram, moments), np.float64)
    if not len(least) or (bounded @ free >= least).all():
        return free
    turned = np.linalg.solve(gram, bounded.T)
    return np.asarray(free + turned @ nonnegative_least_squares(bounded @ turned, least - bounded @ free))


def _minimum_of_free(gram: Doubles, moments: Doubles, x: Doubles, free: Flags) -> Doubles:
    """The minimum over the free unknowns, from ``x``; those that would become negative are held on the way there."""
    while True:
        rows = np.flatnonzero(free)
        part = gram[np.ix_(rows, rows)]
        part = part + ACTIVE_SET_RIDGE * np.diag(np.diag(part))
        goal = np.zeros_like(x)
        goal[rows] = np.linalg.lstsq(part, moments[rows])[0]
        falling = rows[goal[rows] <= 0.0]
        if not falling.size:
            return goal
        share = x[falling] / np.maximum(x[falling] - goal[falling], np.finfo(float).tiny)
        x = x + share.min() * (goal - x)
        free[falling[share == share.min()]] = False
        x[~free] = 0.0
