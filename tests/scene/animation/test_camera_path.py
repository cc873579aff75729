"""Camera paths interpolate smoothly, and load from nerfstudio's files and from keyframes of scene files."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.files.scene_files import refuses, write_scene
from support.scenes.raster_scenes import front_camera


def look(eye, target=(0, 0, 0), **changes: Any) -> ls.Camera:
    """Returns a small camera with y up."""
    return ls.Camera.look_at(eye, target, width=32, height=24, **changes)


KEYS = [look((4, 1, 0)), look((0, 2, 4), fov_y=0.5), look((-4, 1, 1)), look((0, 3, -4))]
TIMES = [0.0, 1.0, 1.5, 4.0]


def test_camera_path_passes_through_each_key_camera_at_its_time():
    """A path equals each camera at its time, and stands still before the first and after the last."""
    path = ls.CameraPath(KEYS, TIMES)
    for time, key in zip(TIMES, KEYS, strict=True):
        np.testing.assert_allclose(path.at(time).camera_from_world, key.camera_from_world, atol=1e-12)
        assert path.at(time).fx == pytest.approx(key.fx)
    np.testing.assert_array_equal(path.at(-3.0).camera_from_world, KEYS[0].camera_from_world)
    np.testing.assert_array_equal(path.at(9.0).camera_from_world, KEYS[-1].camera_from_world)
    assert path.duration == 4.0


@pytest.mark.parametrize("targets", [None, np.zeros((4, 3))])
def test_speed_of_a_camera_path_is_continuous_at_its_key_cameras(targets):
    """Position, direction and lens change at the same speed just before and just after each key."""
    path = ls.CameraPath(KEYS, TIMES, targets)
    step = 1e-5
    for time in TIMES[1:-1]:
        before, at, after = (path.at(time + shift) for shift in (-step, 0.0, step))
        for name in ("eye", "camera_from_world", "fx"):
            speeds = [np.asarray(getattr(b, name)) - getattr(a, name) for a, b in ((before, at), (at, after))]
            np.testing.assert_allclose(speeds[0] / step, speeds[1] / step, atol=2e-3 * max(1.0, at.fx))


def test_camera_path_through_evenly_spaced_points_on_a_line_has_constant_speed():
    """Cubic interpolation reproduces a straight motion at constant speed."""
    path = ls.CameraPath([look((x, 1, 5), (x, 0, 0)) for x in (0, 2, 4, 6)])
    np.testing.assert_allclose(path.at(1.3).eye, (2.6, 1, 5), atol=1e-9)
    np.testing.assert_allclose(path.at(1.3).camera_from_world[:3, :3], path.at(0).camera_from_world[:3, :3], atol=1e-9)


def test_camera_path_through_cameras_with_targets_keeps_targets_at_the_image_centre():
    """The target is centred at all times; without targets, the camera rotates the shorter way."""
    path = ls.CameraPath(KEYS, TIMES, np.zeros((4, 3)))
    for time in np.linspace(0.0, 4.0, 37):
        x, y, z = path.at(time).camera_from_world[:3, 3]
        assert abs(x) < 1e-9 and abs(y) < 1e-9 and z > 0.0
    free = ls.CameraPath([look((0, 0, 5)), look((3, 0, 4))])
    middle = free.at(0.5)
    forward = middle.world_from_camera[:3, 2]
    assert forward @ (-middle.eye / np.linalg.norm(middle.eye)) > 0.99


def test_camera_path_stretched_to_a_duration_has_that_duration():
    """Frames cover the first to the last time, and a stretched path has the requested duration."""
    path = ls.CameraPath(KEYS, [2.0, 3.0, 4.0, 5.0])
    frames = path.frames(10.0)
    assert len(frames) == 31 and frames[0].name == "frame_00000"
    np.testing.assert_allclose(frames[10].eye, KEYS[1].eye, atol=1e-9)
    assert path.stretched(6.0).duration == 6.0
    np.testing.assert_allclose(path.stretched(6.0).at(2.0).eye, KEYS[1].eye, atol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ls.CameraPath([]), "expected at least one"),
        (lambda: ls.CameraPath([KEYS[0], front_camera()]), r"differ in width \(camera 1\)"),
        (lambda: ls.CameraPath(KEYS, [0, 1, 1, 2]), "times of a path must increase"),
        (lambda: ls.CameraPath(KEYS, [0, 1]), "times has shape"),
        (lambda: ls.CameraPath(["a"]), "cameras holds a str"),  # pyright: ignore[reportArgumentType]
        (lambda: ls.CameraPath(KEYS).frames(0), "fps is 0"),
        (lambda: ls.CameraPath(KEYS).at(math.nan), "time is nan"),
    ],
)
def test_camera_path_refuses_invalid_cameras_times_and_rates(make, message):
    """The error is one line."""
    with pytest.raises(ls.SceneError, match=message):
        make()


FRAME = {"camera_to_world": [1, 0, 0, 2, 0, 1, 0, 3, 0, 0, 1, 4, 0, 0, 0, 1], "fov": 50.0, "aspect": 1.5}


def nerfstudio(**changes: Any) -> dict[str, Any]:
    """Returns the content of a camera path file of nerfstudio's viewer."""
    turned = {**FRAME, "camera_to_world": [0, 0, 1, 0, 0, 1, 0, 3, -1, 0, 0, 4, 0, 0, 0, 1]}
    shared = {"camera_type": "perspective", "render_width": 60, "render_height": 40, "fps": 30, "seconds": 0.1}
    return {"keyframes": [], **shared, "is_cycle": False, "camera_path": [FRAME, turned, FRAME], **changes}


def test_nerfstudio_camera_path_loads_as_one_camera_for_each_frame(tmp_path):
    """Poses are OpenGL matrices in row-major order, and fields of view are vertical angles in degrees."""
    (tmp_path / "camera_path.json").write_text(json.dumps(nerfstudio()))
    first, second, _ = ls.load_cameras(tmp_path / "camera_path.json")
    assert (first.width, first.height) == (60, 40)
    assert first.fov_y == pytest.approx(math.radians(50.0))
    np.testing.assert_allclose(first.eye, (2, 3, 4))
    np.testing.assert_allclose(first.world_from_camera[:3, 2], (0, 0, -1))  # looks along -z
    np.testing.assert_allclose(first.world_from_camera[:3, 1], (0, -1, 0))  # y up
    np.testing.assert_allclose(second.world_from_camera[:3, 2], (-1, 0, 0))
    path = ls.io.load_camera_path(tmp_path / "camera_path.json")
    assert path.duration == pytest.approx(2 / 30)
    assert len(path.frames(30.0)) == 3
    np.testing.assert_allclose(path.frames(30.0)[1].camera_from_world, second.camera_from_world, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_type": "equirectangular"}, 'has camera_type "equirectangular", expected perspective or fisheye'),
        ({"camera_path": []}, "has no frames"),
        ({"camera_path": [{**FRAME, "fov": 180}]}, "has fov 180, expected degrees"),
        ({"camera_path": [{"fov": 50}]}, "lacks camera_to_world"),
        ({"camera_path": [{**FRAME, "camera_to_world": [1, 2]}]}, "has camera_to_world"),
        ({"fps": 0}, "has fps 0"),
    ],
)
def test_invalid_nerfstudio_camera_path_files_are_refused(tmp_path, changes, message):
    """The error is one line that names the file."""
    (tmp_path / "camera_path.json").write_text(json.dumps(nerfstudio(**changes)))
    with pytest.raises(ls.FormatError, match=message):
        ls.io.load_camera_path(tmp_path / "camera_path.json")


FLIGHT = """
[[meshes]]
path = "a.obj"
[[cameras]]
name = "still"
eye = [0, 0, 9]
target = [0, 0, 0]
[[cameras]]
name = "flight"
target = [0, 1, 0]
width = 32
height = 24
[[cameras.keyframes]]
time = 0.5
eye = [0, 1, 4]
fov_y_degrees = 40
[[cameras.keyframes]]
time = 2.5
eye = [4, 1, 0]
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    """Returns a folder with a mesh."""
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return tmp_path


def test_camera_keyframes_of_a_scene_file_define_its_camera_path(folder):
    """The first camera with keyframes is the path; keyframes repeat omitted values; `load_cameras` gives its start."""
    path = ls.io.load_camera_path(write_scene(folder, FLIGHT))
    assert path.duration == 2.5 and [camera.name for camera in path.cameras] == ["flight"] * 2
    assert path.cameras[1].fov_y == pytest.approx(math.radians(40))
    x, y, z = path.at(1.2).camera_from_world[:3, :3] @ (0, 1, 0) + path.at(1.2).camera_from_world[:3, 3]
    assert abs(x) < 1e-9 and abs(y) < 1e-9 and z > 0
    still, flight = ls.load_cameras(folder / "scene.toml")
    assert (still.name, flight.name) == ("still", "flight")
    np.testing.assert_allclose(flight.eye, (0, 1, 4), atol=1e-12)


def test_scene_file_with_a_moving_camera_loads_as_an_animation(folder):
    """A moving camera makes an animation without actors, which lasts as long as the camera moves."""
    animation = ls.load_animation(write_scene(folder, FLIGHT + "[animation]\nfps = 10\n"))
    assert animation.frame_count == 25 and animation.camera_path is not None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (FLIGHT.replace("time = 2.5", "time = 0.5"), "times must increase"),
        (FLIGHT.replace("target = [0, 1, 0]\n", ""), "lacks target"),
        (FLIGHT.replace("fov_y_degrees = 40", "fov_y_degrees = 180"), "fov_y_degrees is 180"),
        (FLIGHT.replace("eye = [4, 1, 0]", "eyes = [4, 1, 0]"), "unknown 'eyes', did you mean 'eye'"),
        (FLIGHT.replace("eye = [4, 1, 0]", "eye = [0, 1, 0]"), "eye and target apart"),
    ],
)
def test_invalid_camera_keyframes_of_a_scene_file_are_refused(folder, text, message):
    """The error names the line of the keyframe."""
    with pytest.raises(ls.FormatError) as caught:
        ls.io.load_camera_path(write_scene(folder, text))
    refuses(caught, folder, message)
