"""Least squares with inequality constraints: SciPy's solutions, and the conditions of a minimum."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from lumisplat.math.nonnegative import bounded_least_squares, nonnegative_least_squares


@pytest.mark.parametrize("seed", range(12))
def test_nonnegative_least_squares_matches_scipy(seed):
    """Random problems of many shapes, with half of the free unknowns negative, match SciPy."""
    rng = np.random.default_rng(seed)
    rows, count = int(rng.integers(10, 60)), int(rng.integers(1, 25))
    matrix, target = rng.normal(size=(rows, count)), rng.normal(size=rows)
    expected, _ = nnls(matrix, target)
    found = nonnegative_least_squares(matrix.T @ matrix, matrix.T @ target)
    if rows >= count:
        np.testing.assert_allclose(found, expected, atol=1e-8)
    assert (found >= 0.0).all()
    cost = np.linalg.norm(matrix @ found - target)
    assert cost <= np.linalg.norm(matrix @ expected - target) + 1e-7
    assert ((found == 0.0) == (expected == 0.0)).all() or rows < count


def test_duplicate_columns_do_not_change_a_nonnegative_least_squares_fit():
    """A matrix with three copies of a column gives the same fitted values as with one."""
    column = np.random.default_rng(1).random(30)
    matrix = np.stack([column] * 3, axis=1)
    found = nonnegative_least_squares(matrix.T @ matrix, matrix.T @ (2.0 * column))
    assert (found >= 0.0).all()
    assert found.sum() == pytest.approx(2.0, rel=1e-6)


def test_empty_nonnegative_least_squares_problems_have_zero_solutions():
    """Problems without unknowns, and with zero columns, have the solution 0."""
    assert nonnegative_least_squares(np.zeros((0, 0)), np.zeros(0)).shape == (0,)
    assert not nonnegative_least_squares(np.zeros((3, 3)), np.zeros(3)).any()


@pytest.mark.parametrize("seed", range(6))
def test_bounded_least_squares_minimum_satisfies_the_kkt_conditions(seed):
    """All constraints hold, and only active ones carry the gradient.

    The Karush-Kuhn-Tucker conditions hold at the unique minimum of a convex problem; SciPy's `nnls` finds the
    multipliers.
    """
    rng = np.random.default_rng(seed)
    matrix, target = rng.normal(size=(40, 6)), rng.normal(size=40)
    bounded, least = rng.normal(size=(9, 6)), rng.normal(size=9) - 1.5
    gram, moments = matrix.T @ matrix, matrix.T @ target
    least[0] = bounded[0] @ np.linalg.solve(gram, moments) + 0.3  # the unconstrained minimum violates this bound
    found = bounded_least_squares(gram, moments, bounded, least)
    slack = bounded @ found - least
    assert (slack >= -1e-8).all()
    held = slack < 1e-8
    assert held.any()
    gradient = gram @ found - moments
    multipliers, unexplained = nnls(bounded[held].T, gradient)
    assert unexplained < 1e-6 * np.linalg.norm(moments)
    assert multipliers.max() > 0.0


def test_bounds_that_the_free_least_squares_minimum_satisfies_do_not_change_it():
    """If the unconstrained minimum satisfies the bounds, the bounded minimum equals it."""
    gram, moments = np.diag([2.0, 4.0]), np.array([2.0, 4.0])
    found = bounded_least_squares(gram, moments, np.eye(2), np.zeros(2))
    np.testing.assert_allclose(found, [1.0, 1.0])
