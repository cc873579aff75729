"""Random numbers of data set views, and the geometry that decides whether a pose or an object is accepted."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.dataset.draws import Draws, Purpose, split_of
from lumisplat.dataset.objects import uniform_quaternion
from lumisplat.dataset.space import Solids, even_directions, level_axes, winding_number
from lumisplat.math.transforms import matrices_from_quaternions


def test_random_numbers_of_data_sets_depend_only_on_seed_view_and_purpose() -> None:
    """Values are pinned, because data sets must not change between versions."""
    first = Draws(7, 12, Purpose.POSE).units(3)
    np.testing.assert_array_equal(first, Draws(7, 12, Purpose.POSE).units(3))
    for other in (Draws(8, 12, Purpose.POSE), Draws(7, 13, Purpose.POSE), Draws(7, 12, Purpose.LIGHTS)):
        assert not np.any(first == other.units(3))
    np.testing.assert_allclose(
        first, [0.039097990697983476, 0.10173888738083792, 0.8496143992453818], rtol=0.0, atol=1e-15
    )


def test_random_numbers_of_data_sets_fill_their_ranges_uniformly() -> None:
    """Integers include both ends, factors have a uniform logarithm, directions have mean 0."""
    draws = Draws(1, 2, Purpose.OBJECTS)
    wholes = np.bincount([draws.whole((2, 4)) for _ in range(3000)])
    assert wholes[:2].sum() == 0 and len(wholes) == 5 and abs(wholes[2:] - 1000).max() < 130  # 5 deviations
    factors = np.log([draws.factor((0.25, 4.0)) for _ in range(2000)])
    assert np.abs(factors).max() <= np.log(4.0) and abs(factors.mean()) < 0.09
    directions = np.array([draws.direction() for _ in range(2000)])
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    assert np.abs(directions.mean(axis=0)).max() < 0.065
    np.testing.assert_allclose(directions.T @ directions / 2000, np.eye(3) / 3.0, atol=0.04)


@pytest.mark.parametrize("count", [20, 101, 1000])
def test_data_set_splits_have_the_configured_fractions_for_any_number_of_views(count: int) -> None:
    """Counts are within three views for any seed; the split of a view does not depend on the number of views."""
    fractions = (0.7, 0.2, 0.1)
    for seed in range(20):
        parts = [split_of(seed, view, fractions) for view in range(count)]
        for part, fraction in zip(("train", "val", "test"), fractions, strict=True):
            assert abs(parts.count(part) - fraction * count) < 2.5, (seed, part)
    assert {split_of(0, view, (0.0, 0.0, 1.0)) for view in range(50)} == {"test"}


def test_random_rotations_of_data_sets_are_uniform() -> None:
    """Matrix elements have mean 0 and second moment 1/3."""
    quaternions = np.array([uniform_quaternion(*row) for row in Draws(3, 0, Purpose.OBJECTS).units(4000, 3)])
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0, atol=1e-12)
    rotations = matrices_from_quaternions(quaternions)
    assert np.abs(rotations.mean(axis=0)).max() < 0.05
    np.testing.assert_allclose((rotations**2).mean(axis=0), 1.0 / 3.0, atol=0.03)


def test_winding_number_is_1_inside_a_box_and_0_outside() -> None:
    """The winding number is -1 inside a box whose triangles face inwards."""
    mesh = ls.box((2.0, 1.0, 1.0))
    triangles = mesh.positions[mesh.indices].astype(np.float64)
    for point, expected in (((0.9, 0.4, -0.4), 1.0), ((1.1, 0.0, 0.0), 0.0), ((0.0, 5.0, 0.0), 0.0)):
        assert winding_number(triangles, np.array(point)) == pytest.approx(expected, abs=1e-6)
        assert winding_number(triangles[:, ::-1], np.array(point)) == pytest.approx(-expected, abs=1e-6)


def test_points_inside_objects_count_as_solid_and_points_inside_a_room_do_not() -> None:
    """A mirrored mesh is solid; a box around most of the scene is a room."""
    low, high = np.full(3, -3.0), np.full(3, 3.0)
    mirrored = np.diag((-1.0, 1.0, 1.0, 1.0))
    mirrored[0, 3] = 2.0
    mesh = ls.MeshInstance(ls.box(1.0), mirrored)
    solids = Solids((mesh, ls.MeshInstance(ls.box(6.0))), low, high)
    assert solids.contain(np.array([2.2, 0.1, 0.3])) and not solids.contain(np.array([0.0, 0.1, 0.3]))


def test_data_set_directions_are_spread_evenly_over_the_sphere() -> None:
    """Directions have the moments of the sphere; level axes are horizontal."""
    directions = even_directions(32)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(directions.mean(axis=0), 0.0, atol=0.02)
    np.testing.assert_allclose(directions.T @ directions / 32, np.eye(3) / 3.0, atol=0.02)
    up = np.array([0.0, -0.6, 0.8])
    first, second = level_axes(up)
    np.testing.assert_allclose(
        [first @ up, second @ up, first @ second, first @ first, second @ second], [0, 0, 0, 1, 1], atol=1e-12
    )
