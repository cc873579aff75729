"""Cameras of scene files: single camera entries, and camera files placed with their scene."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.mesh_files import Gltf
from support.files.scene_files import refuses, write_scene
from support.scenes.raster_scenes import front_camera, one_gaussian


def load(folder: Path, text: str, **size: int) -> list[ls.Camera]:
    """Loads the cameras that ``text`` lists."""
    return ls.load_cameras(write_scene(folder, text), **size)


VIEW = """
[[cameras]]
name = "close"
eye = [0, 1, 4]
target = [0, 0.5, 0]
up = [0, -1, 0]
fov_y_degrees = 30
width = 320
height = 200
model = "orthographic"
near = 0.5
exposure = 1.5
aperture = 0.05
focus_distance = 3
"""


def test_scene_file_camera_equals_look_at_with_the_same_values(tmp_path: Path) -> None:
    """The entry adds an exposure."""
    (camera,) = load(tmp_path, VIEW)
    expected = ls.Camera.look_at(
        (0, 1, 4),
        (0, 0.5, 0),
        (0, -1, 0),
        width=320,
        height=200,
        fov_y=math.radians(30),
        near=0.5,
        model=ls.CameraModel.ORTHOGRAPHIC,
        aperture=0.05,
        focus_distance=3,
    )
    np.testing.assert_array_equal(camera.camera_from_world, expected.camera_from_world)
    for name in ("width", "height", "fx", "fy", "near", "model", "aperture", "focus_distance"):
        assert getattr(camera, name) == getattr(expected, name)
    assert (camera.name, camera.exposure) == ("close", 1.5)


def test_scene_file_camera_is_by_default_a_y_up_pinhole_without_depth_of_field(tmp_path: Path) -> None:
    """The size is 1280 x 720, and the name is generated."""
    first, second = load(tmp_path, "[[cameras]]\neye = [0, 0, 4]\ntarget = [0, 0, 0]\n" * 2)
    expected = ls.Camera.look_at((0, 0, 4), (0, 0, 0))
    assert (first.width, first.height, first.fx, first.exposure) == (1280, 720, expected.fx, 0.0)
    np.testing.assert_array_equal(first.camera_from_world, expected.camera_from_world)
    assert (first.name, second.name) == ("frame_00000", "frame_00001")


def test_scene_file_fisheye_field_of_view_may_exceed_180_degrees(tmp_path: Path) -> None:
    """The limit is 360 degrees for a fisheye and 180 for other cameras."""
    text = '[[cameras]]\neye = [0, 0, 4]\ntarget = [0, 0, 0]\nmodel = "fisheye"\nfov_y_degrees = 220\n'
    (camera,) = load(tmp_path, text)
    assert camera.fov_y == pytest.approx(math.radians(220))


def test_scene_file_cameras_are_listed_in_order_of_files_and_entries(tmp_path: Path) -> None:
    """Names are distinct; image sizes and exposure of an entry apply to the cameras of its file."""
    ls.save_cameras(tmp_path / "transforms.json", [front_camera(name="left"), front_camera(name="right")])
    text = (
        '[[cameras]]\npath = "transforms.json"\nwidth = 32\nexposure = -1\n'
        + VIEW
        + '[[cameras]]\npath = "transforms.json"\n'
    )
    cameras = load(tmp_path, text)
    assert [camera.name for camera in cameras] == ["left", "right", "close", "left_2", "right_2"]
    original = front_camera()
    assert (cameras[0].width, cameras[0].exposure) == (32, -1.0)
    assert cameras[0].fx == pytest.approx(original.fx * 32 / original.width)
    assert (cameras[3].width, cameras[3].exposure) == (original.width, 0.0)
    np.testing.assert_allclose(cameras[3].camera_from_world, original.camera_from_world, atol=1e-14)


def camera_glb(folder: Path) -> None:
    """Returns a glTF with a pinhole and an orthographic camera at x = 2."""
    gltf = Gltf()
    gltf.add("cameras", type="perspective", perspective={"yfov": 0.8, "znear": 0.1})
    gltf.add("cameras", type="orthographic", orthographic={"xmag": 3.0, "ymag": 2.0, "znear": 0.1, "zfar": 9.0})
    for index in (0, 1):
        gltf.add("nodes", camera=index, translation=[2, 0, 0], name=f"view{index}")
    (folder / "a.glb").write_bytes(gltf.glb())


def test_scene_and_camera_moved_by_one_scene_file_entry_show_the_same_pixels(tmp_path: Path) -> None:
    """Pinhole and orthographic cameras project a moved point to the same pixel; depth scales with the placement."""
    camera_glb(tmp_path)
    entry = '[[cameras]]\npath = "a.glb"\nheight = 40\n'
    rotation = "position = [1, 2, 3]\nrotation_wxyz = [0.5, 0.1, -0.7, 0.2]\nscale = 2.5\n"
    (tmp_path / "a.obj").write_text("v 2.3 0.4 -3\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    scene = ls.load(write_scene(tmp_path, '[[meshes]]\npath = "a.obj"\n' + rotation))
    assert isinstance(scene, ls.Scene)
    point = np.array([2.3, 0.4, -3.0, 1.0])
    for camera, placed in zip(load(tmp_path, entry), load(tmp_path, entry + rotation), strict=True):
        assert (placed.width, placed.height) == (camera.width, camera.height)
        before, after = camera.camera_from_world @ point, placed.camera_from_world @ scene.meshes[0].transform @ point
        np.testing.assert_allclose(after[:3], 2.5 * before[:3], atol=1e-9)
        lens = camera.fx * before[0], placed.fx * after[0]
        if camera.model is ls.CameraModel.PINHOLE:
            lens = lens[0] / before[2], lens[1] / after[2]
        assert lens[0] == pytest.approx(lens[1])
        assert placed.near == pytest.approx(2.5 * camera.near)


def test_image_size_given_to_load_cameras_applies_only_if_no_file_states_one(tmp_path: Path) -> None:
    """A size in the scene file or camera file wins over the argument."""
    camera_glb(tmp_path)
    assert load(tmp_path, '[[cameras]]\npath = "a.glb"\n', width=64, height=48)[0].width == 64
    assert load(tmp_path, '[[cameras]]\npath = "a.glb"\nwidth = 30\n', width=64, height=48)[0].width == 30


def test_scene_file_without_cameras_gives_an_empty_camera_list(tmp_path: Path) -> None:
    """Loading cameras does not load the captures of the scene."""
    assert load(tmp_path, '[[splats]]\npath = "lost.ply"\n') == []


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[[cameras]]\ntarget = [0, 0, 0]", "line 1, cameras[0]: lacks eye, three numbers"),
        ("[[cameras]]\neye = [0, 0]\ntarget = [0, 0, 0]", "line 2, cameras[0]: eye is [0, 0], expected three numbers"),
        ("[[cameras]]\neye = [0, 0, 0]\ntarget = [0, 0, 0]", "line 2, cameras[0]: look_at needs eye and target apart"),
        (VIEW + "fov = 3", "line 15, cameras[0]: unknown 'fov'"),
        (VIEW.replace("30", "180"), "line 7, cameras[0]: fov_y_degrees is 180, expected more than 0 and less than 180"),
        (VIEW.replace("30", "0"), "line 7, cameras[0]: fov_y_degrees is 0, expected more than 0"),
        (VIEW.replace("320", "0"), "line 8, cameras[0]: camera width is 0, expected a whole number from 1"),
        (VIEW.replace("320", "3.5"), "line 8, cameras[0]: width is 3.5, expected a whole number"),
        (VIEW.replace("orthographic", "wide"), "line 10, cameras[0]: model is 'wide', expected pinhole or fisheye or"),
        (VIEW.replace("0.05", "-1"), "line 13, cameras[0]: camera aperture is -1"),
        (VIEW.replace("1.5", "nan"), "line 12, cameras[0]: camera exposure is nan, expected -100.0 to 100.0"),
        ("[[cameras]]\npath = 'lost.json'", "line 2, cameras[0]: path is 'lost.json', no such file"),
        ("[[cameras]]\npath = 'scene.toml'", "line 2, cameras[0]: path is 'scene.toml', a scene file itself"),
        ("[[cameras]]\npath = 'x'\neye = [0, 0, 0]", "line 3, cameras[0]: unknown 'eye'"),
        ("[cameras]\npath = 'x'", "line 1: cameras must be written with double brackets"),
    ],
)
def test_error_for_an_invalid_camera_of_a_scene_file_names_line_and_key(
    tmp_path: Path, text: str, problem: str
) -> None:
    """The one-line error also names the file."""
    with pytest.raises(ls.FormatError) as caught:
        load(tmp_path, text)
    refuses(caught, tmp_path, problem)


VIEW_WITHOUT_UP = "[[cameras]]\neye = [0, 0, -4]\ntarget = [0, 0, 0]\n"


@pytest.mark.parametrize(
    ("text", "up"),
    [
        ('[[splats]]\npath = "a.ply"\n', (0, -1, 0)),
        ('[[actors]]\npath = "a.ply"\n', (0, -1, 0)),
        ('[[meshes]]\npath = "a.obj"\n', (0, 1, 0)),
        ('up = "y-up"\n[[splats]]\npath = "a.ply"\n', (0, 1, 0)),
        ('up = "x-down"\n[[meshes]]\npath = "a.obj"\n', (-1, 0, 0)),
        ('up = [0, 3, 0]\n[[splats]]\npath = "a.ply"\n', (0, 1, 0)),
    ],
)
def test_up_direction_of_a_scene_file_camera_is_by_default_that_of_the_scene(
    tmp_path: Path, text: str, up: tuple[float, float, float]
) -> None:
    """A capture that is y down is thus not upside down in the image."""
    (camera,) = load(tmp_path, text + VIEW_WITHOUT_UP)
    expected = ls.Camera.look_at((0, 0, -4), (0, 0, 0), up)
    np.testing.assert_array_equal(camera.camera_from_world, expected.camera_from_world)
    (own,) = load(tmp_path, text + VIEW_WITHOUT_UP + 'up = "y-up"\n')
    np.testing.assert_array_equal(own.camera_from_world, ls.Camera.look_at((0, 0, -4), (0, 0, 0)).camera_from_world)


@pytest.mark.parametrize("text", ['up = "sideways"\n', "up = [0, 0, 0]\n", "up = 3\n", 'up = "y-up"\nup = "y-down"\n'])
def test_error_for_an_invalid_up_key_of_a_scene_file_names_its_line(tmp_path: Path, text: str) -> None:
    """The error names the file, the line and the key."""
    with pytest.raises(ls.FormatError) as caught:
        load(tmp_path, text + VIEW_WITHOUT_UP)
    refuses(caught, tmp_path, "up" if text.count("up =") == 1 else "TOML")


def test_up_key_of_a_scene_file_sets_the_up_direction_of_the_loaded_scene(tmp_path: Path) -> None:
    """Framing without cameras and upright entries use this up direction, too."""
    ls.save(tmp_path / "a.ply", one_gaussian())
    scene = ls.load(write_scene(tmp_path, 'up = "z-up"\n[[splats]]\npath = "a.ply"\n'))
    assert isinstance(scene, ls.Scene) and scene.up_direction == (0.0, 0.0, 1.0)


def test_lens_distortion_of_a_scene_file_camera_is_read(tmp_path: Path) -> None:
    """A moving camera keeps the distortion; an error names the line."""
    text = "[[cameras]]\neye = [0, 1, 4]\ntarget = [0, 0, 0]\ndistortion = [-0.1, 0.02, 0, 0, 0.001, -0.002]\n"
    (camera,) = load(tmp_path, text)
    assert camera.distortion == (-0.1, 0.02, 0.0, 0.0, 0.001, -0.002)
    path = ls.io.load_camera_path(
        write_scene(tmp_path, text + "keyframes = [{ time = 0 }, { time = 1, eye = [1, 1, 4] }]\n")
    )
    assert path.at(0.5).distortion == camera.distortion
    for wrong, problem in (
        (text.replace("[-0.1, 0.02, 0,", "[-0.1,"), "expected six numbers, k1 k2 k3 k4 p1 p2"),
        (text + 'model = "orthographic"\n', "camera distortion needs a pinhole or fisheye camera"),
    ):
        with pytest.raises(ls.FormatError) as caught:
            load(tmp_path, wrong)
        refuses(caught, tmp_path, problem)
