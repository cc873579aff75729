"""COLMAP sparse models, packed here byte by byte from COLMAP's documentation."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.transforms import rotation_matrix

ROTATION = (0.5, -0.5, 0.5, 0.5)
LENSES = {
    1: ("PINHOLE", 1, (500.0, 510.0, 322.0, 238.0)),
    2: ("OPENCV", 4, (500.0, 510.0, 322.0, 238.0, 0.1, -0.02, 0.003, -0.004)),
    3: ("SIMPLE_RADIAL", 2, (480.0, 320.0, 240.0, 0.05)),
    4: ("OPENCV_FISHEYE", 5, (300.0, 301.0, 320.0, 240.0, 0.01, 0.02, 0.03, 0.04)),
}
IMAGES = [(7, ROTATION, (1.0, 2.0, 3.0), 2, "room/b 1.jpg"), (3, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 4.0), 1, "a.png")]


def write_binary(folder: Path, images=IMAGES, lenses=LENSES) -> Path:
    """Writes a binary model; each image has two 2D points."""
    cameras = struct.pack("<Q", len(lenses))
    for number, (_, model, values) in lenses.items():
        cameras += struct.pack(f"<iiQQ{len(values)}d", number, model, 640, 480, *values)
    poses = struct.pack("<Q", len(images))
    for number, rotation, move, lens, name in images:
        poses += struct.pack("<i7di", number, *rotation, *move, lens) + name.encode() + b"\0"
        poses += struct.pack("<Qddqddq", 2, 1.0, 2.0, -1, 3.0, 4.0, 5)
    (folder / "cameras.bin").write_bytes(cameras)
    (folder / "images.bin").write_bytes(poses)
    return folder


def write_text(folder: Path) -> Path:
    """Writes the model of `write_binary` as text; one image has no 2D points, so its second line is empty."""
    lines = ["# Camera list with one line of data per camera:"]
    lines += [f"{n} {name} 640 480 {' '.join(map(str, values))}" for n, (name, _, values) in LENSES.items()]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for k, (number, rotation, move, lens, name) in enumerate(IMAGES):
        lines += [f"{number} {' '.join(map(str, (*rotation, *move)))} {lens} {name}", "" if k else "1 2 -1 3 4 5"]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("write", [write_binary, write_text])
@pytest.mark.parametrize("named", ["", "images", "cameras"])
def test_colmap_model_is_read_as_cameras_from_folder_or_file(tmp_path, write, named):
    """Poses have OpenCV axes, in the order of the model's images."""
    write(tmp_path)
    suffix = ".bin" if write is write_binary else ".txt"
    first, second = ls.load_cameras(tmp_path / (named + suffix) if named else tmp_path)
    assert (first.name, second.name) == ("b 1", "a")
    np.testing.assert_allclose(first.camera_from_world[:3, :3], rotation_matrix(ROTATION), atol=1e-12)
    np.testing.assert_array_equal(first.camera_from_world[:3, 3], (1.0, 2.0, 3.0))
    np.testing.assert_array_equal(second.eye, (0.0, 0.0, -4.0))
    assert (first.width, first.height, first.fx, first.fy, first.cx, first.cy) == (640, 480, 500.0, 510.0, 322.0, 238.0)
    assert first.distortion == (0.1, -0.02, 0.0, 0.0, 0.003, -0.004) and not second.is_distorted


def test_colmap_lens_parameters_set_focal_lengths_and_distortion(tmp_path):
    """COLMAP's camera models have one or two focal lengths, radial coefficients, or a fisheye lens."""
    images = [(k, ROTATION, (0.0, 0.0, 0.0), k, f"{k}.png") for k in LENSES]
    pinhole, _, radial, fisheye = ls.load_cameras(write_binary(tmp_path, images))
    assert pinhole.distortion == (0.0,) * 6
    assert (radial.fx, radial.fy, radial.distortion) == (480.0, 480.0, (0.05, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert fisheye.model is ls.CameraModel.FISHEYE
    assert (fisheye.fy, fisheye.distortion) == (301.0, (0.01, 0.02, 0.03, 0.04, 0.0, 0.0))


@pytest.mark.parametrize(("model", "name"), [(6, "FULL_OPENCV"), (12, "SIMPLE_DIVISION"), (99, "model 99")])
def test_error_for_unsupported_colmap_camera_names_the_model(tmp_path, model, name):
    """The error also lists the supported models."""
    write_binary(tmp_path, lenses={**LENSES, 5: (name, model, (1.0,) * 12)})
    with pytest.raises(ls.FormatError, match=rf"camera 5 is a {name}, expected SIMPLE_PINHOLE, PINHOLE"):
        ls.load_cameras(tmp_path)


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f: (f / "images.bin").unlink(), r"has no images.bin or images.txt"),
        (lambda f: (f / "images.bin").write_bytes((f / "images.bin").read_bytes()[:-30]), "truncated in image"),
        (lambda f: (f / "cameras.bin").write_bytes((f / "cameras.bin").read_bytes()[:-9]), "ends too early"),
        (lambda f: (f / "cameras.bin").write_bytes(struct.pack("<Q", 2**62)), "ends too early"),
        (lambda f: (f / "images.bin").write_bytes(struct.pack("<Q", 0)), "no images with a pose"),
        (lambda f: write_binary(f, [(1, ROTATION, (0, 0, 0), 9, "a.png")]), "camera 9, which is not in the model"),
        (lambda f: write_binary(f, [(1, (0, 0, 0, 0), (0, 0, 0), 1, "a.png")]), r"image 1 \(a.png\).*zero length"),
    ],
)
def test_error_for_a_damaged_colmap_model_names_the_file(tmp_path, break_it, message):
    """The error is one line and begins with the file's path."""
    write_binary(tmp_path)
    break_it(tmp_path)
    with pytest.raises(ls.FormatError, match=message) as caught:
        ls.load_cameras(tmp_path)
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)
