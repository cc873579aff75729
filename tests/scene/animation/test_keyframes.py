"""Keyframes interpolate poses along the shorter rotation, and refuse invalid values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation, Slerp

import lumisplat as ls
from lumisplat.math.transforms import matrices_from_quaternions, quaternions_from_matrices


def test_positions_and_scales_are_linear_in_time_between_keyframes():
    """Positions and scales are linear in time, and constant before the first and after the last key."""
    frames = ls.Keyframes([1.0, 3.0], positions=[[0, 0, 0], [4, -2, 0]], scales=[1.0, 3.0])
    for time, share in ((-5.0, 0.0), (1.0, 0.0), (1.5, 0.25), (3.0, 1.0), (8.0, 1.0)):
        pose = frames.at(time)
        np.testing.assert_allclose(pose[:3, :3], (1.0 + 2.0 * share) * np.eye(3), atol=1e-12)
        np.testing.assert_allclose(pose[:3, 3], share * np.array([4.0, -2.0, 0.0]), atol=1e-12)
        np.testing.assert_array_equal(pose[3], [0.0, 0.0, 0.0, 1.0])
    assert frames.duration == 3.0
    np.testing.assert_array_equal(ls.Keyframes([0.0]).at(7.0), np.eye(4))


@given(seed=st.integers(0, 2**32 - 1), time=st.floats(-0.5, 3.5))
def test_rotations_between_keyframes_equal_slerp_of_scipy(seed, time):
    """Slerp over several keys equals SciPy's, for any length and sign of the quaternions."""
    rng = np.random.default_rng(seed)
    quaternions = rng.standard_normal((4, 4))
    pose = ls.Keyframes(np.arange(4.0), rotations_wxyz=quaternions).at(time)
    wanted = Slerp(np.arange(4.0), Rotation.from_quat(np.roll(quaternions, -1, axis=1)))(np.clip(time, 0.0, 3.0))
    np.testing.assert_allclose(pose[:3, :3], wanted.as_matrix(), atol=1e-7)


def test_rotation_of_a_microradian_between_keyframes_is_interpolated():
    """A rotation by a microradian between two keys is half done half-way."""
    turn = Rotation.from_rotvec([0.0, 0.0, 1e-6]).as_quat()
    pose = ls.Keyframes([0.0, 1.0], rotations_wxyz=[[1, 0, 0, 0], np.roll(turn, 1)]).at(0.5)
    assert pose[1, 0] == pytest.approx(5e-7, rel=1e-6)


@given(seed=st.integers(0, 2**32 - 1))
def test_quaternions_convert_to_rotation_matrices_and_back(seed):
    """Quaternions convert to SciPy's matrices and back, up to their sign."""
    quaternions = np.random.default_rng(seed).standard_normal((20, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    matrices = matrices_from_quaternions(quaternions)
    np.testing.assert_allclose(matrices, Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix(), atol=1e-12)
    back = quaternions_from_matrices(matrices)
    np.testing.assert_allclose(np.abs((back * quaternions).sum(axis=1)), 1.0, atol=1e-12)


NAN = float("nan")


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"times": []}, "times is empty"),
        ({"times": [0.0, NAN]}, "times has 1 non-finite values out of 2"),
        ({"times": [0.0, 2.0, 1.0]}, r"times must increase, but 1 follows 2 \(key 2\)"),
        ({"times": [0.0, 0.0]}, "times must increase, but 0 follows 0"),
        ({"times": [0.0], "positions": [[0.0, NAN, np.inf]]}, "positions has 2 non-finite values"),
        ({"times": [0.0], "positions": [0.0, 1.0, 2.0]}, "positions has shape"),
        ({"times": [0.0, 1.0], "positions": [[0.0, 1.0, 2.0]]}, "with K = 2 from times"),
        ({"times": [0.0], "rotations_wxyz": [[0.0, 0.0, 0.0, 0.0]]}, "zero length at keyframe 0"),
        ({"times": [0.0], "scales": [0.0]}, "scales has 0, expected positive"),
        ({"times": ["soon"]}, "times is not an array of numbers"),
    ],
)
def test_error_for_an_invalid_array_of_keyframes_names_the_array(values, problem):
    """The error names the array and the key."""
    with pytest.raises(ls.SceneError, match=problem):
        ls.Keyframes(**values)


@pytest.mark.parametrize("time", [NAN, np.inf, None, "0"])
def test_keyframes_refuse_times_that_are_not_finite_numbers(time):
    """Times must be finite numbers."""
    with pytest.raises(ls.SceneError, match="time is"):
        ls.Keyframes([0.0]).at(time)
