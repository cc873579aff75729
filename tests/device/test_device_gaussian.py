"""Tests of the rasteriser's projection of Gaussians, called from Python."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings, strategies as st

from lumisplat.constants import ALPHA_MAX, ALPHA_MIN
from lumisplat.device.splat.projection import alpha_from_log, gaussian_normal, projection_jacobian
from lumisplat.device.structs.camera import CameraData
from lumisplat.renderer.scene.camera_table import camera_table
from support.oracles import raster_oracle as oracles
from support.scenes.raster_scenes import front_camera

unit = st.floats(-1.0, 1.0)
rotations = st.tuples(unit, unit, unit, unit).filter(lambda q: np.linalg.norm(q) > 0.1)


def camera_data(**changes: object) -> CameraData:
    """Returns the front camera as ``CameraData``, with ``changes`` applied."""
    camera = replace(front_camera(), **changes)
    data = CameraData()
    row = camera_table(camera)[0]
    for name in ("focal", "raster_center", "jacobian_min", "jacobian_max"):
        setattr(data, name, wp.vec2(*(float(value) for value in row[name])))
    return data


@given(st.floats(float(np.log(ALPHA_MIN)), 0.0))
def test_polynomial_alpha_of_the_rasteriser_approximates_the_exponential(log_alpha: float) -> None:
    """The polynomial matches exp to two millionths over its range and is clamped at 0.99."""
    expected = min(np.exp(np.float32(log_alpha), dtype=np.float64), ALPHA_MAX)
    assert alpha_from_log(log_alpha) == pytest.approx(expected, rel=2e-6)


def test_rasterised_alpha_is_monotonic_in_the_gaussian_response() -> None:
    """Alpha never decreases when the response increases."""
    values = [alpha_from_log(float(x)) for x in np.linspace(np.log(ALPHA_MIN), 0.0, 2000)]
    assert (np.diff(values) >= 0.0).all() and values[0] >= ALPHA_MIN * (1.0 - 1e-6)


@settings(max_examples=50)
@given(unit, unit, st.floats(0.05, 50.0))
def test_projection_jacobian_matches_central_differences(x: float, y: float, z: float) -> None:
    """The Jacobian of the projection matches central differences for points inside the image."""
    camera = front_camera()
    point = np.array([0.5 * x * z, 0.35 * y * z, z])

    def pixel(p: np.ndarray) -> np.ndarray:
        return np.array([camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy])

    step = 1e-5 * z
    expected = np.stack([(pixel(point + d) - pixel(point - d)) / (2.0 * step) for d in step * np.eye(3)], axis=1)
    actual = np.array(projection_jacobian(camera_data(), wp.vec3(*point))).reshape(2, 3)
    np.testing.assert_allclose(actual, expected, atol=1e-4 * camera.fx / z)


@pytest.mark.parametrize(
    ("cx", "side", "limit"), [(32.0, 1, 0.5333), (32.0, -1, -0.5333), (10.0, 1, 0.9), (10.0, -1, -0.1667)]
)
def test_projection_jacobian_is_clamped_outside_the_image(cx: float, side: int, limit: float) -> None:
    """The clamp lies 0.3 half image widths beyond the image's edge, measured from the principal point."""
    margin = 0.3 * 0.5 * 64.0 / 60.0
    jacobian = np.array(projection_jacobian(camera_data(cx=cx), wp.vec3(side * 90.0, 0.0, 2.0))).reshape(2, 3)
    assert jacobian[0, 2] == pytest.approx(-30.0 * (limit + side * margin), rel=1e-3)
    assert jacobian[0, 0] == pytest.approx(30.0)


def test_normal_of_tiny_gaussians_does_not_overflow_float32() -> None:
    """Scales whose inverse squares exceed float32 still give a normal, since only their ratios matter."""
    axes = oracles.rotation_from_quaternion(np.array([[0.5, 0.5, 0.5, 0.5]]))[0]
    tiny = np.array(gaussian_normal(wp.mat33(axes), wp.vec3(2e-25, 1e-25, 3e-25), wp.vec3(0.3, 0.4, 0.5)))
    usual = np.array(gaussian_normal(wp.mat33(axes), wp.vec3(2.0, 1.0, 3.0), wp.vec3(0.3, 0.4, 0.5)))
    np.testing.assert_allclose(tiny, usual, atol=1e-6)


@settings(max_examples=60)
@given(rotations, st.tuples(*[st.floats(-6.0, 2.0)] * 3), st.tuples(unit, unit, st.floats(0.2, 1.0)))
def test_normal_of_a_gaussian_is_that_of_its_plane_of_maximum_density(
    quaternion: tuple[float, ...], log_scales: tuple[float, ...], to_eye: tuple[float, ...]
) -> None:
    """The normal is inverse(covariance) (eye - mean), normalised and facing the viewer; scales span eight decades."""
    q = np.array(quaternion) / np.linalg.norm(quaternion)
    axes = oracles.rotation_from_quaternion(q[None])[0].astype(np.float32).astype(np.float64)
    scales = np.exp(log_scales)
    actual = np.array(gaussian_normal(wp.mat33(axes), wp.vec3(*scales), wp.vec3(*to_eye)))
    expected = axes / scales**2 @ axes.T @ np.array(to_eye)
    expected /= np.linalg.norm(expected)
    assert actual @ to_eye > -1e-6
    # If to_eye is nearly in the plane of a thin Gaussian, float32 cannot resolve the normal.
    local = np.abs(axes.T @ to_eye)
    if local[scales.argmin()] > 1e-3:
        np.testing.assert_allclose(actual, expected, atol=1e-3)
