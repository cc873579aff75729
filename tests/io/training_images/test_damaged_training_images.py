"""Damaged or unsuitable image folders are refused with one clear line."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from PIL import Image

import lumisplat as ls
from lumisplat.io.cameras.colmap import read_colmap_points
from support.files.training_image_files import (
    change_frame,
    ring_cameras,
    write_blender_images,
    write_colmap_images,
    write_nerfstudio_images,
)

POINTS = np.random.default_rng(3).normal(size=(7, 3))
CAMERAS = ring_cameras(3, 12, 8)
NAN_POSE = np.full((4, 4), np.nan).tolist()


@pytest.fixture
def nerfstudio(tmp_path) -> Path:
    """Image folder with a transforms.json."""
    return write_nerfstudio_images(tmp_path / "n", CAMERAS)


@pytest.fixture
def colmap(tmp_path) -> Path:
    """Image folder with a COLMAP model."""
    return write_colmap_images(tmp_path / "c", CAMERAS, POINTS)


def refusal(folder: Path, **options: Any) -> str:
    """Returns the one-line error of loading a folder."""
    with pytest.raises(ls.FormatError) as caught:
        ls.io.load_training_images(folder, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value).replace(str(folder.parent), "")


def test_error_for_a_folder_without_training_images_gives_advice(tmp_path):
    """The error states what is expected."""
    assert refusal(tmp_path).endswith(
        ": has no images with poses: expected transforms.json (nerfstudio), transforms_train.json (Blender) or a "
        "COLMAP sparse model in sparse/0; for images without poses, find_poses (--poses colmap) creates one"
    )
    with pytest.raises(ls.errors.MissingFileError, match="nowhere: no such folder"):
        ls.io.load_training_images(tmp_path / "nowhere")
    (tmp_path / "transforms.json").write_text('{"frames": []}')
    assert "transforms.json: lists no images: expected 'frames'" in refusal(tmp_path)
    (tmp_path / "transforms.json").write_text("[1, 2]")
    assert "lists no images" in refusal(tmp_path)
    (tmp_path / "transforms.json").write_text('{"frames": [')
    assert "transforms.json: invalid JSON at line 1" in refusal(tmp_path)
    assert "transforms.json: is a file, expected the folder that holds" in refusal(tmp_path / "transforms.json")


def test_error_for_missing_training_images_states_their_number_and_names(nerfstudio, colmap):
    """The error has the count, the first names and the expected folder."""
    for folder, listed in ((nerfstudio, "transforms.json"), (colmap, "sparse/0")):
        shutil.rmtree(folder / "images")
        message = refusal(folder)
        assert f"{listed}: none of its 3 images exists (" in message and "view_0.png, " in message
        assert message.endswith("n or its images" if folder is nerfstudio else "/c"), "where they were looked for"


def test_single_training_image_is_refused(nerfstudio, colmap):
    """A set with one image left after skipping missing images is refused, too."""
    for folder in (nerfstudio, colmap):
        for name in ("view_0.png", "view_2.png"):
            (folder / "images" / name).unlink()
        assert "has a single image, expected two or more: depth needs several viewpoints" in refusal(folder)


def test_training_image_of_another_size_than_its_camera_is_refused(nerfstudio, colmap):
    """The error names both sizes and both files."""
    for folder, listed in ((nerfstudio, "transforms.json"), (colmap, "sparse/0")):
        Image.new("RGB", (6, 4)).save(folder / "images" / "view_1.png")
        message = refusal(folder)
        assert "images/view_1.png: has 6 x 4 pixels, but its camera in " in message
        assert f"{listed} has 12 x 8: expected the images that the cameras were computed from" in message


def test_nonfinite_poses_of_training_images_are_refused(nerfstudio, colmap, tmp_path):
    """The error names the frame, in every layout."""
    change_frame(nerfstudio / "transforms.json", 1, transform_matrix=NAN_POSE)
    assert "transforms.json: frame 1 (images/view_1.png) has transform_matrix" in refusal(nerfstudio)
    images = (colmap / "sparse/0/images.bin").read_bytes()
    at = images.index(b"view_1.png") - struct.calcsize("<di")
    (colmap / "sparse/0/images.bin").write_bytes(images[:at] + struct.pack("<d", np.nan) + images[at + 8 :])
    assert "sparse/0/images.bin: image 2 (view_1.png): " in refusal(colmap)
    blender = write_blender_images(tmp_path / "b", {"train": CAMERAS})
    change_frame(blender / "transforms_train.json", 2, transform_matrix=NAN_POSE)
    assert "transforms_train.json: frame 2 (./train/view_2) has transform_matrix" in refusal(blender)


def test_training_images_of_orthographic_cameras_are_refused(nerfstudio):
    """The error names the camera and its type."""
    content = json.loads((nerfstudio / "transforms.json").read_text()) | {"camera_model": "ORTHOPHOTO"}
    (nerfstudio / "transforms.json").write_text(json.dumps(content))
    assert "view_0 is of an orthographic camera, expected a pinhole or a fisheye" in refusal(nerfstudio)


def test_invalid_training_masks_are_refused_when_loading(nerfstudio):
    """Masks are black, of another size, missing or no image; the error does not wait until their pixels are decoded."""
    (nerfstudio / "masks").mkdir()
    mask = nerfstudio / "masks" / "view_1.png"
    Image.new("L", (12, 8)).save(mask)
    assert "masks/view_1.png: is black everywhere, so no pixel of its image would be used" in refusal(nerfstudio)
    Image.new("RGBA", (12, 8), (255, 255, 255, 0)).save(mask)
    assert "masks/view_1.png: is black everywhere" in refusal(nerfstudio)
    Image.new("L", (12, 9), 255).save(mask)
    assert "masks/view_1.png: has 12 x 9 pixels, expected the 12 x 8 of " in refusal(nerfstudio)
    mask.write_bytes(b"no picture")
    assert "masks/view_1.png: is not a readable image" in refusal(nerfstudio)
    mask.unlink()
    change_frame(nerfstudio / "transforms.json", 0, mask_path="masks/lost.png")
    assert 'transforms.json: names the mask "masks/lost.png", which does not exist' in refusal(nerfstudio)


def test_damaged_training_images_are_refused(nerfstudio, tmp_path):
    """Garbage and truncated images are refused on loading, transparent ones when their pixels are decoded."""
    blender = write_blender_images(tmp_path / "b", {"train": CAMERAS}, alpha=0.0)
    with pytest.raises(ls.FormatError, match=r"view_0.png: is transparent everywhere: there is nothing to train with"):
        ls.io.load_training_images(blender).held_out[0].pixels()
    image = nerfstudio / "images" / "view_1.png"
    whole = image.read_bytes()
    image.write_bytes(whole[: len(whole) // 2])
    assert refusal(nerfstudio).endswith(
        "view_1.png: is truncated or damaged: copy it again, or remove it to leave the image out"
    )
    image.write_bytes(b"no picture")
    assert "view_1.png: is not a readable image" in refusal(nerfstudio)


def test_error_for_a_training_image_deleted_after_loading_names_it(nerfstudio):
    """Decoding a deleted image raises an error with its name; cached images remain available."""
    views = ls.io.load_training_images(nerfstudio, hold_out=0).training
    views[0].pixels()
    shutil.rmtree(nerfstudio / "images")
    views[0].pixels()
    with pytest.raises(ls.errors.MissingFileError, match=r"view_1.png: no such file"):
        views[1].pixels()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale": 0.0}, "scale is 0.0, expected more than 0 and at most 1"),
        ({"scale": 1.5}, "scale is 1.5"),
        ({"scale": np.nan}, "scale is nan"),
        ({"scale": "half"}, "scale is 'half'"),
        ({"hold_out": 1}, "hold_out is 1, which leaves no image to train with: expected 2 or more, or 0"),
        ({"hold_out": -1}, "hold_out is -1, expected a whole number from 0"),
        ({"hold_out": 2.0}, "hold_out is 2.0"),
        ({"cache_bytes": -1}, "cache_bytes is -1"),
        ({"background": "mauve-ish"}, "background is 'mauve-ish', expected three numbers"),
    ],
)
def test_load_training_images_refuses_invalid_settings_before_it_opens_the_folder(options, message):
    """The folder does not exist."""
    with pytest.raises(ls.ConfigError, match=message):
        ls.io.load_training_images("nowhere", **cast(Any, options))


@pytest.mark.parametrize("cut", [0, 4, 8, 30, 51, 58, -1, -8])
def test_error_for_a_truncated_colmap_point_file_names_it(colmap, cut):
    """Files may end within the count, a point or a track, or be empty."""
    path = colmap / "sparse/0/points3D.bin"
    path.write_bytes(path.read_bytes()[:cut])
    message = refusal(colmap)
    assert "sparse/0/points3D.bin: " in message and ("truncated" in message or "ends too early" in message or not cut)


def test_nonfinite_colmap_points_are_refused_and_counted(colmap, tmp_path):
    """Points are binary or text; text with too few values or colours out of range is refused, too."""
    path = colmap / "sparse/0/points3D.bin"
    stored = bytearray(path.read_bytes())
    stored[16:24] = struct.pack("<d", np.inf)
    path.write_bytes(stored)
    assert "has 1 of 7 points without a finite position, the first is 0" in refusal(colmap)
    text = write_colmap_images(tmp_path / "t", CAMERAS, POINTS, text=True) / "sparse/0/points3D.txt"
    for line, problem in (
        ("1 nan 0 0 1 2 3 0.5", "has 1 of 1 points without a finite position"),
        ("1 0 0 0 1", "point 0 has too few values"),
        ("1 0 0 0 1 2 300 0.5", "has a colour outside of 0..255"),
        ("1 0 0 zero 1 2 3 0.5", "damaged, or not the points of a COLMAP sparse model"),
    ):
        text.write_text(line + "\n")
        assert problem in refusal(tmp_path / "t")


def mutated(data: bytes, changes: list[tuple[int, int]], cut: int) -> bytes:
    """Returns data with some bytes changed or its end cut off."""
    changed = bytearray(data)
    for offset, value in changes:
        changed[offset % len(changed)] = value
    return bytes(changed[: len(changed) - cut % len(changed)])


MUTATIONS = (
    st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, 255)), max_size=6),
    st.sampled_from([0, 0, 3, 40]),
)
CHECKED = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])


def survives(path: Path, data: bytes, read: Callable[[], object]) -> None:
    """Loads a folder with a changed file: it loads or raises a one-line error."""
    original = path.read_bytes()
    path.write_bytes(data)
    try:
        read()
    except ls.FormatError as error:
        assert "\n" not in str(error)
    finally:
        path.write_bytes(original)


@CHECKED
@given(*MUTATIONS)
def test_mutated_colmap_points_either_load_or_are_refused(colmap, changes, cut):
    """Random bytes of points3D.bin give a one-line error or finite points."""
    path = colmap / "sparse/0/points3D.bin"

    def read() -> None:
        found = read_colmap_points(path.parent)
        if found is not None:
            assert np.isfinite(found[0]).all() and len(found[0]) == len(found[1])

    survives(path, mutated(path.read_bytes(), changes, cut), read)


@CHECKED
@given(*MUTATIONS)
def test_mutated_colmap_images_either_load_or_are_refused(colmap, changes, cut):
    """Random bytes of images.bin are changed."""
    path = colmap / "sparse/0/images.bin"
    survives(path, mutated(path.read_bytes(), changes, cut), lambda: ls.io.load_training_images(colmap))


@CHECKED
@given(*MUTATIONS)
def test_mutated_transforms_json_either_loads_or_is_refused(nerfstudio, changes, cut):
    """Random bytes of transforms.json are changed."""
    path = nerfstudio / "transforms.json"
    survives(path, mutated(path.read_bytes(), changes, cut), lambda: ls.io.load_training_images(nerfstudio))


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.just("images/view_0.png"),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)
KEYS = ("file_path", "mask_path", "transform_matrix", "w", "h", "fl_x", "cx", "k1", "camera_model", "camera_angle_x")


@CHECKED
@given(st.sampled_from(KEYS), VALUES, st.booleans())
def test_random_values_in_transforms_json_either_load_or_are_refused(nerfstudio, key, value, shared):
    """Random JSON replaces a value of the file or of one frame."""
    path = nerfstudio / "transforms.json"
    content = json.loads(path.read_text())
    (content if shared else content["frames"][1])[key] = value
    survives(path, json.dumps(content).encode(), lambda: ls.io.load_training_images(nerfstudio))
