"""Least squares with inequality constraints, for many equations in few unknowns, solved from the normal equations."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from lumisplat.math.arrays import Doubles

RANK_TOLERANCE = 1e-13
"""Eigenvalue, relative to the largest, below which a direction of the unknowns counts as undetermined."""


def nonnegative_least_squares(gram: Doubles, moments: Doubles) -> Doubles:
    """Returns the vector x >= 0 of n unknowns that minimises ``x^T G x / 2 - m^T x``.

    With ``G = A^T A`` and ``m = A^T y``, x minimises ``|A x - y|``.

    Args:
        gram: G, symmetric, positive semidefinite, shape (n, n).
        moments: m, in the range of G, shape (n,).

    Returns:
        x, shape (n,); unknowns at their bound are exactly 0.
    """
    # All A and y with the same normal equations have the same solution: the eigenvectors of G give a small square A.
    values, vectors = np.linalg.eigh(gram)
    used = values > RANK_TOLERANCE * values.max(initial=0.0)
    roots = np.sqrt(values[used])
    if not used.any():
        return np.zeros(len(moments))
    return nnls(roots[:, None] * vectors[:, used].T, vectors[:, used].T @ moments / roots)[0]


def bounded_least_squares(gram: Doubles, moments: Doubles, bounded: Doubles, least: Doubles) -> Doubles:
    """Returns the vector x of n unknowns with ``B x >= b`` that minimises ``x^T G x / 2 - m^T x``.

    In coordinates in which G is the identity and the unconstrained minimum is the origin, x is the shortest vector that
    satisfies the inequalities. This is a non-negative least-squares problem (least distance programming, Lawson and
    Hanson 1974, chapter 23).

    Args:
        gram: G, symmetric, positive definite, shape (n, n).
        moments: m, shape (n,).
        bounded: B, one row for each of k constraints, shape (k, n).
        least: b, shape (k,); some x satisfies all constraints.

    Returns:
        x, shape (n,); the constraints hold up to rounding.
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
