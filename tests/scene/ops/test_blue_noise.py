"""Neighbour search agrees with brute force, and Poisson-disk elimination spaces points evenly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lumisplat.scene.ops.neighbours import cell_order, cross_pairs, neighbour_pairs, poisson_disk


def brute_force(points: np.ndarray, others: np.ndarray, radius: float) -> set[tuple[int, int]]:
    """Returns all pairs (i, j) with point i of the first set closer than ``radius`` to point j of the second."""
    distance = np.linalg.norm(points[:, None] - others[None], axis=2)
    return {(int(i), int(j)) for i, j in np.argwhere(distance < radius)}


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.05, 2.0), st.sampled_from([0.0, -1.0, 1e4]))
def test_neighbour_pairs_within_a_radius_equal_brute_force(seed: int, radius: float, offset: float) -> None:
    """Every close pair is found exactly once, on both sides of the origin and far from it."""
    points = np.random.default_rng(seed).uniform(offset - 1.0, offset + 1.0, (60, 3)).astype(np.float32)
    pairs = neighbour_pairs(points, radius)
    found = [tuple(sorted(pair)) for pair in zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)]
    assert len(found) == len(set(found))
    assert set(found) == {(i, j) for i, j in brute_force(points, points, radius) if i < j}
    np.testing.assert_allclose(
        pairs.distance, np.linalg.norm(points[pairs.first] - points[pairs.second], axis=1), rtol=1e-5
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.05, 2.0))
def test_pairs_between_two_point_sets_equal_brute_force(seed: int, radius: float) -> None:
    """Every close pair between two sets is found exactly once, with the first set's index first."""
    rng = np.random.default_rng(seed)
    points, others = (rng.normal(size=(size, 3)).astype(np.float32) for size in (50, 20))
    pairs = cross_pairs(points, others, radius)
    found = list(zip(pairs.first.tolist(), pairs.second.tolist(), strict=True))
    assert len(found) == len(set(found))
    assert set(found) == brute_force(points, others, radius)


@pytest.mark.parametrize("far", [1e15, 1e30])
def test_points_too_far_away_for_integer_cell_indices_have_no_neighbours(far: float) -> None:
    """Points beyond the range of cell indices have no neighbours, and cause no warning."""
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 3)).astype(np.float32)
    strays = np.array([[far, 0.0, 0.0], [-far, far, far]], np.float32)
    found, alone = neighbour_pairs(np.concatenate([points, strays]), 0.3), neighbour_pairs(points, 0.3)
    assert {*zip(found.first.tolist(), found.second.tolist(), strict=True)} == {
        *zip(alone.first.tolist(), alone.second.tolist(), strict=True)
    }


def test_poisson_disk_selection_leaves_points_neither_too_close_nor_with_gaps() -> None:
    """Selected points of a dense square are far apart, and every other point is near a selected one."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.random((4000, 2)), np.zeros(4000)]).astype(np.float32)
    spacing = (1.0 / 800) ** 0.5
    pairs = neighbour_pairs(points, 0.86 * spacing)
    selected = poisson_disk(pairs, rng.permutation(4000), 800, 0.86 * spacing)
    assert selected.shape == (800,)
    assert (np.diff(selected) > 0).all()
    distance = np.linalg.norm(points[selected][:, None] - points[selected][None], axis=2) + 9.0 * np.eye(800)
    assert distance.min() > 0.6 * spacing
    assert np.linalg.norm(points[:, None] - points[selected][None], axis=2).min(axis=1).max() < 0.87 * spacing


def test_poisson_disk_selects_of_two_close_points_that_of_smaller_priority_number() -> None:
    """Of two points that are too close, the one with the smaller priority number stays."""
    points = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [5.0, 0.0, 0.0]])
    pairs = neighbour_pairs(points, 1.0)
    np.testing.assert_array_equal(poisson_disk(pairs, np.array([1, 0, 2]), 2, 1.0), [1, 2])
    np.testing.assert_array_equal(poisson_disk(pairs, np.array([0, 1, 2]), 2, 1.0), [0, 2])


@pytest.mark.parametrize("count", [1, 5, 10])
def test_poisson_disk_selects_the_requested_number_of_coincident_points(count: int) -> None:
    """Ten copies of one point still give the requested count."""
    points = np.zeros((10, 3))
    assert poisson_disk(neighbour_pairs(points, 1.0), np.arange(10), count, 1.0).size == count


def test_sorting_points_by_grid_cell_puts_spatial_neighbours_next_to_each_other() -> None:
    """Consecutive points in cell order are much closer than in random order."""
    points = np.random.default_rng(0).random((2000, 3))
    ordered = points[cell_order(points, 0.1)]
    assert (
        np.linalg.norm(np.diff(ordered, axis=0), axis=1).mean()
        < 0.3 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()
    )
