"""Least squares whose unknowns obey inequalities, from the normal equations: many rows, few unknowns."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from lumisplat.math.arrays import Doubles

RANK_TOLERANCE = 1e-13
"""Eigenvalue, relative to the largest, up to which a combination of unknowns is not determined."""


def nonnegative_least_squares(gram: Doubles, moments: Doubles) -> Doubles:
    """Returns the x of at least 0 that minimises ``x^T G x / 2 - m^T x``.

    With ``G = A^T A`` and ``m = A^T y`` it minimises ``|A x - y|``.

    Args:
        gram: G, symmetric, positive semidefinite, shape (n, n).
        moments: m, in the range of G, shape (n,).

    Returns:
        Shape (n,); unknowns at their bound are exactly 0.
    """
    # Any A and y of the same normal equations have the same solution: those of the eigenvectors of G are square.
    values, vectors = np.linalg.eigh(gram)
    used = values > RANK_TOLERANCE * values.max(initial=0.0)
    roots = np.sqrt(values[used])
    if not used.any():
        return np.zeros(len(moments))
    return nnls(roots[:, None] * vectors[:, used].T, vectors[:, used].T @ moments / roots)[0]


def bounded_least_squares(gram: Doubles, moments: Doubles, bounded: Doubles, least: Doubles) -> Doubles:
    """Returns the x with ``B x >= b`` that minimises ``x^T G x / 2 - m^T x``.

    Seen from the free minimum, in units in which G is 1, it is the shortest vector that satisfies the inequalities: a
    non-negative problem (least distance programming, Lawson and Hanson 1974, chapter 23).

    Args:
        gram: G, symmetric, positive definite, shape (n, n).
        moments: m, shape (n,).
        bounded: B, shape (k, n).
        least: b, shape (k,); some x satisfies all of them.

    Returns:
        Shape (n,); inequalities hold to rounding.
    """
    lower = np.linalg.cholesky(gram)
    free: Doubles = np.asarray(np.linalg.solve(gram, moments), np.float64)
    missing = least - bounded @ free
    if not (missing > 0.0).any():
        return free
    rows = np.vstack([np.linalg.solve(lower, bounded.T), missing])
    target = np.zeros(len(rows))
    target[-1] = 1.0
    residual = rows @ nnls(rows, target)[0] - target
    return np.asarray(free - np.linalg.solve(lower.T, residual[:-1]) / residual[-1])
