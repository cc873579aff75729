"""Tests of directions around an axis and of the device's arctangent."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

from lumisplat.device.math.directions import angle_of, around

AXES = [np.array(axis) for axis in ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0))]
AXES += [v / np.linalg.norm(v) for v in np.random.default_rng(0).normal(size=(20, 3))]
AXES += [v / np.linalg.norm(v) for v in np.array([(1e-6, 2e-6, -1.0), (1e-6, -2e-6, 1.0), (1.0, 1.0, -1e-7)])]


@pytest.mark.parametrize("axis", AXES)
def test_directions_around_an_axis_are_unit_vectors_at_the_given_angles(axis: np.ndarray) -> None:
    """The azimuth runs counterclockwise about every axis; its argument is a fraction of a full rotation."""
    angle = 0.7
    found = [
        np.array(around(wp.vec3(*axis), math.cos(angle), math.sin(angle), azimuth))
        for azimuth in (0.0, 0.25, 0.5, 0.75)
    ]
    for direction in found:
        assert direction @ axis == pytest.approx(math.cos(angle), abs=1e-6)
        assert np.linalg.norm(direction) == pytest.approx(1.0, abs=1e-6)
    flat = [(direction - math.cos(angle) * axis) / math.sin(angle) for direction in found]
    np.testing.assert_allclose(np.cross(flat[0], flat[1]), axis, atol=1e-6)
    np.testing.assert_allclose(flat[0] + flat[2], 0.0, atol=1e-6)
    np.testing.assert_allclose(flat[1] + flat[3], 0.0, atol=1e-6)


def test_device_function_angle_of_matches_numpy_arctan2() -> None:
    """``angle_of`` matches NumPy's arctan2 in all quadrants and next to the axes, and returns 0 for (0, 0)."""
    rng = np.random.default_rng(1)
    pairs = rng.normal(size=(2000, 2)) * 10.0 ** rng.uniform(-6.0, 6.0, (2000, 2))
    pairs = np.concatenate([pairs, [(a, b) for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0)]]).astype(np.float32)
    found = [angle_of(float(y), float(x)) for y, x in pairs]
    np.testing.assert_allclose(found, np.arctan2(*pairs.T.astype(np.float64)), atol=4e-7)
    assert angle_of(0.0, 0.0) == 0.0
