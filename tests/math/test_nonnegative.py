"""Least squares with inequalities: SciPy's answers, and the conditions that a minimum obeys."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from lumisplat.math.nonnegative import bounded_least_squares, nonnegative_least_squares


@pytest.mark.parametrize("seed", range(12))
def test_nonnegative_is_scipys(seed):
    """Random problems of all shapes, half of whose unknowns want to be negative."""
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


def test_columns_that_are_alike_are_no_trouble():
    """The same column three times explains what one does."""
    column = np.random.default_rng(1).random(30)
    matrix = np.stack([column] * 3, axis=1)
    found = nonnegative_least_squares(matrix.T @ matrix, matrix.T @ (2.0 * column))
    assert (found >= 0.0).all()
    assert found.sum() == pytest.approx(2.0, rel=1e-6)


def test_nothing_is_nothing():
    """No unknowns, and columns of zeros."""
    assert nonnegative_least_squares(np.zeros((0, 0)), np.zeros(0)).shape == (0,)
    assert not nonnegative_least_squares(np.zeros((3, 3)), np.zeros(3)).any()


@pytest.mark.parametrize("seed", range(6))
def test_bounds_are_kept_at_the_minimum(seed):
    """Inequalities that hold, and a gradient that only those that hold exactly push against.

    These conditions (Karush, Kuhn and Tucker) are those of the one minimum of a convex problem;
    SciPy's `nnls` looks for the multipliers.
    """
    rng = np.random.default_rng(seed)
    matrix, target = rng.normal(size=(40, 6)), rng.normal(size=40)
    bounded, least = rng.normal(size=(9, 6)), rng.normal(size=9) - 1.5
    gram, moments = matrix.T @ matrix, matrix.T @ target
    least[0] = bounded[0] @ np.linalg.solve(gram, moments) + 0.3  # the free minimum breaks it
    found = bounded_least_squares(gram, moments, bounded, least)
    slack = bounded @ found - least
    assert (slack >= -1e-8).all()
    held = slack < 1e-8
    assert held.any()
    gradient = gram @ found - moments
    multipliers, unexplained = nnls(bounded[held].T, gradient)
    assert unexplained < 1e-6 * np.linalg.norm(moments)
    assert multipliers.max() > 0.0


def test_bounds_that_do_not_hold_it_change_nothing():
    """The free minimum, if it obeys them."""
    gram, moments = np.diag([2.0, 4.0]), np.array([2.0, 4.0])
    found = bounded_least_squares(gram, moments, np.eye(2), np.zeros(2))
    np.testing.assert_allclose(found, [1.0, 1.0])
