"""The pinhole camera is validated, looks at targets, and keeps its view at other sizes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

import lumisplat as ls
from support.scenes.raster_scenes import front_camera

coordinates = st.tuples(*[st.floats(-10.0, 10.0)] * 3)


def pixel_of(camera: ls.Camera, point: np.ndarray) -> np.ndarray:
    """Returns the pixel of a world point, and its view depth."""
    x, y, z = camera.camera_from_world[:3, :3] @ point + camera.camera_from_world[:3, 3]
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z])


@given(coordinates, coordinates)
def test_camera_look_at_centres_its_target_and_shows_the_up_direction_upwards(
    eye: tuple[float, ...], target: tuple[float, ...]
) -> None:
    """Points above the target are higher in the image, and points to its right are further right."""
    offset = np.subtract(target, eye)
    distance = float(np.linalg.norm(offset))
    if np.linalg.norm(np.cross(offset, (0.0, 1.0, 0.0))) < 1e-3 * distance or distance < 1e-3:
        return
    camera = ls.Camera.look_at(eye, target, width=200, height=100, fov_y=0.7)
    np.testing.assert_allclose(pixel_of(camera, np.array(target)), [100.0, 50.0, distance], atol=1e-6 * (1 + distance))
    np.testing.assert_allclose(camera.eye, eye, atol=1e-9)
    assert camera.fov_y == pytest.approx(0.7)
    above = pixel_of(camera, np.add(target, (0.0, 1e-3 * distance, 0.0)))
    assert above[1] < 50.0 and abs(above[0] - 100.0) < 1e-6 * distance + 1e-6
    right = pixel_of(camera, np.array(target) + 1e-3 * np.cross(offset, (0.0, 1.0, 0.0)))
    assert right[0] > 100.0
    assert np.linalg.det(camera.camera_from_world) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "camera width is 0"),
        ({"height": 1.5}, "camera height is 1.5, expected a whole number"),
        ({"width": np.nan}, "camera width is nan, expected a whole number"),
        ({"width": 100_000}, "from 1 to 65536"),
        ({"fx": "a"}, "camera fx is 'a', expected a number above 0"),
        ({"fx": 0.0}, "camera fx is 0.0"),
        ({"fy": np.nan}, "camera fy is nan"),
        ({"fy": np.inf}, "camera fy is inf"),
        ({"near": 0.0}, "camera near is 0.0"),
        ({"cx": np.nan}, "camera cx is nan, expected a finite number"),
        ({"camera_from_world": [[1.0, 0.0], [0.0]]}, "not a matrix of numbers"),
        ({"camera_from_world": np.eye(3)}, r"shape \(3, 3\), expected \(4, 4\)"),
        ({"camera_from_world": np.zeros((4, 4))}, "last row"),
        ({"camera_from_world": np.diag([1.0, 1.0, 0.0, 1.0])}, "singular"),
        ({"camera_from_world": np.diag([2.0, 2.0, 2.0, 1.0])}, "not rigid"),
        ({"camera_from_world": np.diag([1.0, 1.0, -1.0, 1.0])}, "not rigid"),
        ({"camera_from_world": np.full((4, 4), np.nan)}, "non-finite"),
    ],
)
def test_error_for_an_invalid_camera_value_names_the_value(changes: dict[str, Any], message: str) -> None:
    """The error names the value and what was expected, in one line."""
    with pytest.raises(ls.SceneError, match=message):
        front_camera(**changes)


@pytest.mark.parametrize(
    "arguments",
    [
        {"eye": (0, 0, 0), "target": (0, 0, 0)},
        {"eye": (0, 0, 0), "target": (0, 3, 0)},
        {"eye": (0, 0, 0), "target": (0, 0, 1), "up": (0, 0, 0)},
        {"eye": (0, 0, 0), "target": (0, 0, 1), "fov_y": 0.0},
        {"eye": (0, 0, 0), "target": (0, 0, 1), "fov_y": 3.2},
        {"eye": (0, 0, 0), "target": (0, 0, 1), "fov_y": "wide"},
        {"eye": (0, 0, 0), "target": (0, 0, 1), "height": "tall"},
        {"eye": (0, 0), "target": (0, 0, 1)},
        {"eye": "here", "target": (0, 0, 1)},
        {"eye": (0, 0, 0), "target": ((0, 0), (1,))},
        {"eye": (0, 0, 0), "target": (0, 0, 1), "up": (0, float("nan"), 0)},
    ],
)
def test_camera_look_at_refuses_impossible_views(arguments: dict[str, Any]) -> None:
    """A camera needs a target, an up direction and a field of view."""
    with pytest.raises(ls.SceneError):
        ls.Camera.look_at(**arguments)


def test_scaled_camera_shows_points_at_the_same_image_fraction() -> None:
    """A point stays at the same fraction of the image at any size."""
    camera = front_camera(64, 48, cx=20.0, cy=30.0)
    point = np.array([0.3, -0.2, 2.0])
    half = camera.scaled(width=32)
    assert (half.width, half.height) == (32, 24)
    np.testing.assert_allclose(pixel_of(half, point)[:2], pixel_of(camera, point)[:2] / 2.0)
    assert (camera.scaled(height=96).width, camera.scaled(height=96).fx) == (128, 120.0)
    odd = camera.scaled(100, 30)
    np.testing.assert_allclose(pixel_of(odd, point)[:2] / (100, 30), pixel_of(camera, point)[:2] / (64, 48))
    assert camera.scaled() is camera
