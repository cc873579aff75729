"""Camera files: axes, intrinsics, names, round trips, and a one-line error for each fault."""

from __future__ import annotations

import json
import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.errors import FormatError, SceneError
from lumisplat.io import load_cameras, save_cameras
from lumisplat.scene.camera import Camera
from support.files.mesh_files import png_bytes

IDENTITY = np.eye(4).tolist()
FRAME: dict[str, Any] = {"file_path": "images/0001.png", "transform_matrix": IDENTITY}
FILE: dict[str, Any] = {"w": 8, "h": 6, "fl_x": 10.0, "fl_y": 11.0, "cx": 4.5, "cy": 2.5, "frames": [FRAME]}
INRIA = {
    "id": 0,
    "img_name": "00001",
    "width": 8,
    "height": 6,
    "position": [1, 2, 3],
    "rotation": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
    "fx": 10.0,
    "fy": 11.0,
}


def load(tmp_path: Path, content: object) -> list[Camera]:
    """Writes the content as JSON and loads it."""
    (tmp_path / "cameras.json").write_text(content if isinstance(content, str) else json.dumps(content))
    return load_cameras(tmp_path / "cameras.json")


def test_nerfstudio_poses_have_opengl_axes(tmp_path: Path) -> None:
    """An OpenGL camera at the identity looks along -z with +y up: image x is world x, image y is world -y."""
    (camera,) = load(tmp_path, FILE)
    np.testing.assert_array_equal(camera.camera_from_world[:3, :3], np.diag([1, -1, -1]))
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (8, 6, 10, 11, 4.5, 2.5)
    assert camera.name == "0001"


def test_inria_poses_have_opencv_axes(tmp_path: Path) -> None:
    """The columns of INRIA's rotation are the camera's x, y and z axes in the world; its position is the eye."""
    (camera,) = load(tmp_path, [INRIA])
    np.testing.assert_allclose(camera.eye, (1, 2, 3), atol=1e-12)
    forward_x = camera.camera_from_world @ (1 + 5, 2, 3, 1)  # rotation's third column is world +x
    np.testing.assert_allclose(forward_x, (0, 0, 5, 1), atol=1e-12)
    assert (camera.cx, camera.cy) == (4, 3)


def test_camera_values_of_a_frame_override_those_of_the_whole_file(tmp_path: Path) -> None:
    """Cameras have the order and the names of the frames in the file."""
    frames = [FRAME, {**FRAME, "file_path": "images/0000.png", "w": 16, "fl_x": 20.0}]
    first, second = load(tmp_path, {**FILE, "frames": frames})
    assert (first.name, second.name) == ("0001", "0000")
    assert (first.width, second.width, second.fx, second.fy) == (8, 16, 20.0, 11.0)


def test_focal_length_follows_from_angle_of_view_and_image_size(tmp_path: Path) -> None:
    """NeRF's synthetic scenes store an angle of view; the size is that of the image file."""
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "r_0.png").write_bytes(png_bytes(np.zeros((30, 40, 3), np.uint8)))
    content = {"camera_angle_x": 0.5 * math.pi, "frames": [{**FRAME, "file_path": "./train/r_0"}]}
    (camera,) = load(tmp_path, content)
    assert (camera.width, camera.height, camera.cx, camera.cy) == (40, 30, 20, 15)
    assert camera.fx == pytest.approx(20.0)
    assert camera.fy == pytest.approx(20.0)


def test_load_cameras_uses_the_callers_image_size_only_if_the_file_has_none(tmp_path: Path) -> None:
    """The caller's size is used only if neither the camera file nor an image states one."""
    (tmp_path / "a.json").write_text(json.dumps({"camera_angle_x": 0.5 * math.pi, "frames": [FRAME]}))
    (camera,) = ls.load_cameras(tmp_path / "a.json", width=40, height=30)
    assert (camera.width, camera.height, camera.cx, camera.cy) == (40, 30, 20, 15)
    assert camera.fx == pytest.approx(20.0)
    with pytest.raises(FormatError, match="give --width and --height"):
        ls.load_cameras(tmp_path / "a.json", width=40)
    (tmp_path / "b.json").write_text(json.dumps(FILE))
    assert ls.load_cameras(tmp_path / "b.json", width=40, height=30)[0].width == FILE["w"]


def test_loaded_cameras_have_unique_names_even_if_the_file_repeats_them(tmp_path: Path) -> None:
    """Output images are named after cameras, so repeated names get a number and missing names the frame's number."""
    paths = ["a/1.png", "b/1.png", "", "c/view.left"]
    cameras = load(tmp_path, {**FILE, "frames": [{**FRAME, "file_path": p} for p in paths]})
    assert [camera.name for camera in cameras] == ["1", "1_2", "frame_00002", "view.left"]


def test_saved_transforms_json_loads_as_equal_cameras(tmp_path: Path) -> None:
    """Order and names are kept, and numbers to float precision."""
    rng = np.random.default_rng(4)
    cameras = [
        replace(
            Camera.look_at(rng.normal(size=3) * 5, rng.normal(size=3), fov_y=0.3 + k, width=64 + k, name=f"v.{k}"),
            cx=31.25,
        )
        for k in range(3)
    ]
    save_cameras(tmp_path / "transforms.json", cameras)
    for camera, loaded in zip(cameras, load_cameras(tmp_path / "transforms.json"), strict=True):
        np.testing.assert_allclose(loaded.camera_from_world, camera.camera_from_world, atol=1e-14)
        for name in ("width", "height", "fx", "fy", "cx", "cy", "name"):
            assert getattr(loaded, name) == getattr(camera, name)


@pytest.mark.parametrize(
    ("keys", "model"),
    [
        ({}, ls.CameraModel.PINHOLE),
        ({"camera_model": "OPENCV"}, ls.CameraModel.PINHOLE),
        ({"camera_type": "perspective"}, ls.CameraModel.PINHOLE),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.0, "k4": 0.0}, ls.CameraModel.FISHEYE),
        ({"is_fisheye": True}, ls.CameraModel.FISHEYE),
        ({"camera_type": "fisheye"}, ls.CameraModel.FISHEYE),
        ({"camera_model": "ORTHOPHOTO"}, ls.CameraModel.ORTHOGRAPHIC),
    ],
)
def test_camera_model_names_of_nerfstudio_and_instant_ngp_are_read(
    tmp_path: Path, keys: dict[str, object], model: ls.CameraModel
) -> None:
    """Focal lengths do not depend on the camera model."""
    (camera,) = load(tmp_path, {**FILE, **keys})
    assert camera.model is model
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (10, 11, 4.5, 2.5)


@pytest.mark.parametrize("model", list(ls.CameraModel))
def test_saved_transforms_json_keeps_the_camera_model(tmp_path: Path, model: ls.CameraModel) -> None:
    """The model is written once for the whole file, where nerfstudio reads it."""
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), width=20, height=10, fov_y=0.7, model=model)
    save_cameras(tmp_path / "transforms.json", [camera, camera])
    saved = json.loads((tmp_path / "transforms.json").read_text())
    names = {"pinhole": "OPENCV", "fisheye": "OPENCV_FISHEYE", "orthographic": "ORTHOPHOTO"}
    assert saved["camera_model"] == names[model.value]
    for loaded in load_cameras(tmp_path / "transforms.json"):
        np.testing.assert_allclose(loaded.ray_directions(), camera.ray_directions(), atol=1e-15)
        assert (loaded.model, loaded.fx) == (model, camera.fx)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"aperture": 0.1}, r"camera 1 \(late\) has an aperture"),
        ({"camera_from_world_end": np.eye(4)}, r"camera 1 \(late\) has a rolling shutter"),
        ({"model": ls.CameraModel.FISHEYE}, "one camera model, got fisheye and pinhole"),
    ],
)
def test_save_cameras_refuses_apertures_rolling_shutters_and_several_camera_models(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    """The error names the camera and its rolling shutter, aperture or other model, and no file is written."""
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), name="late")
    with pytest.raises(SceneError, match=message):
        save_cameras(tmp_path / "transforms.json", [camera, replace(camera, **changes)])
    assert not list(tmp_path.iterdir())


def test_save_cameras_logs_dropped_exposures_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One log line covers any number of cameras; there is none if all exposures are 0."""
    camera = Camera.look_at((1, 2, 3), (0, 0, 0))
    with caplog.at_level(logging.WARNING, "lumisplat"):
        save_cameras(tmp_path / "plain.json", [camera, camera])
        assert not caplog.records
        save_cameras(tmp_path / "bright.json", [replace(camera, exposure=1.0), replace(camera, exposure=2.0)])
    assert ["cannot hold the exposure" in record.getMessage() for record in caplog.records] == [True]
    assert load_cameras(tmp_path / "bright.json")[0].exposure == 0.0


def test_save_cameras_refuses_an_empty_list_and_writes_no_file(tmp_path: Path) -> None:
    """The error says that there are no cameras."""
    with pytest.raises(SceneError, match="no cameras"):
        save_cameras(tmp_path / "transforms.json", [])
    assert not list(tmp_path.iterdir())


def test_lens_distortion_survives_saving_and_loading_cameras(tmp_path: Path) -> None:
    """Coefficients may be stored for the whole file or for one frame."""
    first, second = load(tmp_path, {**FILE, "k1": 0.1, "p2": -0.02, "frames": [FRAME, {**FRAME, "k1": 0.3, "k4": 0.5}]})
    assert first.distortion == (0.1, 0.0, 0.0, 0.0, 0.0, -0.02)
    assert second.distortion == (0.3, 0.0, 0.0, 0.5, 0.0, -0.02)
    save_cameras(tmp_path / "again.json", [first, second])
    assert [camera.distortion for camera in load_cameras(tmp_path / "again.json")] == [
        first.distortion,
        second.distortion,
    ]


def pose(*diagonal: float) -> dict:
    """Returns the content of a camera file with one frame whose pose has the given diagonal."""
    return {**FILE, "frames": [{**FRAME, "transform_matrix": np.diag([*diagonal, 1.0]).tolist()}]}


def without(content: dict, *names: str) -> dict:
    """Returns the content without the given keys."""
    return {key: value for key, value in content.items() if key not in names}


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "is empty"),
        ("{\n\n  nonsense", "invalid JSON at line 3"),
        ("3", "not a camera file"),
        ({"a": 1}, "not a camera file"),
        ([{"a": 1}], "not a camera file"),
        ([3], "damaged, or not a camera file"),
        (without(FILE, "frames"), "not a camera file"),
        ({**FILE, "frames": []}, "has no frames"),
        ([], "has no frames"),
        (pose(1, 1, 0), r"frame 0 \(images/0001.png\) has a singular pose"),
        (pose(1, 2, 1), "frame 0 .* stretches"),
        (pose(2, 2, 2), "frame 0 .* scaled by 2"),
        (pose(-1, 1, 1), "frame 0 .* mirrors"),
        (pose(math.nan, 1, 1), "frame 0 .* expected 4 x 4 finite numbers"),
        ({**FILE, "frames": [{"file_path": "x"}]}, r"frame 0 \(x\) lacks transform_matrix"),
        (
            {**FILE, "frames": [{**FRAME, "transform_matrix": [[1, 2], [3]]}]},
            r"has transform_matrix \[\[1, 2\], \[3\]\], expected",
        ),
        ({**FILE, "frames": [FRAME, 7]}, "frame 1 is 7, expected an object"),
        ({**FILE, "w": 0}, "frame 0 .* width is 0"),
        ({**FILE, "h": 0}, "frame 0 .* height is 0"),
        ({**FILE, "h": -4}, "frame 0 .* height is -4"),
        ({**FILE, "w": 1e9}, "frame 0 .* width is 1000000000"),
        ({**FILE, "fl_x": 0}, "frame 0 .* fx is 0"),
        ({**FILE, "fl_x": None}, "frame 0 .* has fl_x null, expected a number"),
        ({**FILE, "w": "800"}, 'frame 0 .* has w "800", expected a number'),
        ({**FILE, "w": None}, "frame 0 .* has w null, expected a number"),
        ([{**INRIA, "position": "here"}], 'has position "here", expected 3 finite numbers'),
        ("[" * 100_000, "nested too deeply"),
        ("\N{BYTE ORDER MARK}ply\n", r"invalid JSON at line 1.* expected transforms\.json or cameras\.json"),
        (without(FILE, "fl_x"), "frame 0 .* no intrinsics"),
        (without({**FILE, "camera_angle_x": 4.0}, "fl_x"), "frame 0 .* camera_angle_x 4.0"),
        (without(FILE, "w"), "frame 0 .* no w and h"),
        ({**FILE, "camera_model": "EQUIRECTANGULAR"}, 'frame 0 .* has camera_model "EQUIRECTANGULAR", expected one of'),
        ({**FILE, "camera_type": "equirectangular"}, 'has camera_type "equirectangular", expected one of'),
        ({**FILE, "camera_model": 7}, "has camera_model 7, expected one of OPENCV"),
        ({**FILE, "frames": [FRAME, {**FRAME, "camera_model": "FOV"}]}, 'frame 1 .* has camera_model "FOV"'),
        (without({**FILE, "camera_model": "OPENCV_FISHEYE", "camera_angle_x": 1.0}, "fl_x"), "frame 0 .* lacks fl_x"),
        ([{**INRIA, "width": 0}], r"frame 0 \(00001\) camera width is 0"),
        ([INRIA, without(INRIA, "fx")], r"frame 1 \(00001\) lacks fx"),
        ([{**INRIA, "rotation": np.zeros((3, 3)).tolist()}], "frame 0 .* singular"),
    ],
)
def test_invalid_camera_files_are_refused(tmp_path: Path, content: object, expected: str) -> None:
    """The one-line error names the file, the frame and the fault."""
    with pytest.raises(FormatError, match=expected) as raised:
        load(tmp_path, content)
    assert str(raised.value).startswith(str(tmp_path / "cameras.json") + ": ")
    assert "\n" not in str(raised.value)


def test_load_cameras_has_different_errors_for_missing_files_and_for_folders(tmp_path: Path) -> None:
    """The two messages are "no such file" and "is a folder"."""
    with pytest.raises(FormatError, match="no such file"):
        load_cameras(tmp_path / "none.json")
    with pytest.raises(FormatError, match="is a folder"):
        load_cameras(tmp_path)
