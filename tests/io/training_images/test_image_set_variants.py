"""Image sets as other programs write them: masks, test files, several models, Windows paths, unusual text."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from support.files.training_image_files import (
    ring_cameras,
    write_blender_images,
    write_colmap_images,
    write_nerfstudio_images,
)

POINTS = np.random.default_rng(3).normal(size=(7, 3))
HALF = np.zeros((30, 40), np.uint8)
HALF[:, :20] = 255


@pytest.mark.parametrize(
    "name",
    ["{}.png.mask.png", "{}.mask.png", "{}_mask.png", "{}-mask.png", "{}_MASK.PNG", "{}.jpg", "{}.png.jpg", "{}.tif"],
)
@pytest.mark.parametrize("folder", ["masks", "mask"])
def test_training_masks_are_found_by_common_names(tmp_path: Path, name: str, folder: str) -> None:
    """Mask names of COLMAP, nerfstudio, RealityScan and other programs are recognised."""
    write_colmap_images(tmp_path, ring_cameras(3), POINTS)
    (tmp_path / folder).mkdir()
    for k in range(3):
        Image.fromarray(HALF).save(tmp_path / folder / name.format(f"view_{k}"))
    for view in ls.io.load_training_images(tmp_path, hold_out=0).training:
        mask = view.mask()
        assert mask is not None
        np.testing.assert_array_equal(mask, HALF > 0)


def test_training_masks_are_found_beside_images_and_in_mask_folders(tmp_path: Path) -> None:
    """Masks in ``masks/a`` belong to images in ``images/a``."""
    write_nerfstudio_images(tmp_path, ring_cameras(3))
    content = json.loads((tmp_path / "transforms.json").read_text())
    for directory in ("images/left", "masks/left"):
        (tmp_path / directory).mkdir(parents=True)
    (tmp_path / "images/view_0.png").rename(tmp_path / "images/left/view_0.png")
    content["frames"][0]["file_path"] = "images/left/view_0.png"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    Image.fromarray(HALF).save(tmp_path / "masks/left/view_0_mask.png")
    Image.fromarray(HALF).save(tmp_path / "images/view_1.png.mask.png")
    masks = {view.name: view.mask() for view in ls.io.load_training_images(tmp_path, hold_out=0).training}
    assert masks["view_0"] is not None and masks["view_1"] is not None and masks["view_2"] is None


def test_training_masks_without_an_image_are_counted_in_a_log_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The masks of a folder match no image, or only some images."""
    write_colmap_images(tmp_path, ring_cameras(3), POINTS)
    (tmp_path / "masks").mkdir()
    Image.fromarray(HALF).save(tmp_path / "masks" / "other_7.png")
    assert ls.io.load_training_images(tmp_path, hold_out=0).training[0].mask() is None
    assert "masks is ignored: none of its 1 files (other_7.png) is named after an image" in caplog.text
    caplog.clear()
    Image.fromarray(HALF).save(tmp_path / "masks" / "view_0.png")
    ls.io.load_training_images(tmp_path, hold_out=0)
    assert "masks has masks for only 1 of 3 images" in caplog.text


@pytest.mark.parametrize("has_val", [False, True])
def test_validation_or_training_images_are_held_out_if_blender_test_images_are_missing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, has_val: bool
) -> None:
    """A log line names the images held out instead: those of the validation file, else training images."""
    cameras = ring_cameras(6, 16, 12)
    write_blender_images(tmp_path, {"train": cameras[:4], "test": cameras[4:5], "val": cameras[5:]})
    shutil.rmtree(tmp_path / "test")
    if not has_val:
        shutil.rmtree(tmp_path / "val")
        (tmp_path / "transforms_val.json").unlink()
    found = ls.io.load_training_images(tmp_path)
    assert [view.path.parent.name for view in found.held_out] == ["val" if has_val else "train"]
    assert len(found.training) == (4 if has_val else 3)
    expected = "the images of transforms_val.json are held out" if has_val else "some training images are held out"
    assert "none of its images exists" in caplog.text and expected in caplog.text


def test_colmap_model_with_the_most_images_is_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A log line counts the other models and the images that the chosen model lacks."""
    cameras = ring_cameras(7, 16, 12)
    for model, part in (("sparse/0", cameras[:2]), ("sparse/2", cameras[4:]), ("sparse/10", cameras[2:4])):
        write_colmap_images(tmp_path, part, POINTS, model=model, text=model == "sparse/2")
    found = ls.io.load_training_images(tmp_path, hold_out=0)
    assert [view.name for view in found.training] == ["view_4", "view_5", "view_6"]
    assert "has 3 models: 2 with 3 images is used; 0 with 2, 10 with 2 are not used" in caplog.text
    assert "4 of 7 images have no pose (view_0.png, view_1.png, view_2.png, ...)" in caplog.text
    assert [camera.name for camera in ls.load_cameras(tmp_path)] == ["view_4", "view_5", "view_6"]
    (tmp_path / "sparse/2/images.txt").write_bytes(b"\x00\xff")  # a damaged model is not chosen
    assert len(ls.io.load_training_images(tmp_path, hold_out=0).training) == 2


def test_training_images_without_a_pose_are_counted_in_a_log_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The line also has the first names."""
    cameras = ring_cameras(4, 16, 12)
    write_nerfstudio_images(tmp_path, cameras)
    content = json.loads((tmp_path / "transforms.json").read_text())
    del content["frames"][2]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    Image.fromarray(HALF).resize((16, 12)).save(tmp_path / "images/view_0.png.mask.png")
    assert len(ls.io.load_training_images(tmp_path, hold_out=0).training) == 3
    assert "1 of 4 images have no pose (view_2.png)" in caplog.text


@pytest.mark.parametrize("layout", ["transforms", "colmap", "split"])
def test_backslashes_in_training_image_paths_are_separators(tmp_path: Path, layout: str) -> None:
    """Backslashes separate folders unless a file has that very name."""
    cameras = ring_cameras(3, 16, 12)
    if layout == "colmap":
        write_colmap_images(tmp_path, cameras, POINTS, text=True)
        (tmp_path / "images/left").mkdir()
        for camera in cameras:
            (tmp_path / f"images/{camera.name}.png").rename(tmp_path / f"images/left/{camera.name}.png")
        listed = tmp_path / "sparse/0/images.txt"
        listed.write_text(listed.read_text().replace("view_", "left\\view_"))
    else:
        write_nerfstudio_images(tmp_path, cameras)
        content = json.loads((tmp_path / "transforms.json").read_text())
        for frame in content["frames"]:
            frame["file_path"] = frame["file_path"].replace("/", "\\")
        if layout == "split":
            content["train_filenames"] = [frame["file_path"] for frame in content["frames"][:2]]
            content["test_filenames"] = ["images/view_2.png"]
        (tmp_path / "transforms.json").write_text(json.dumps(content))
    found = ls.io.load_training_images(tmp_path, hold_out=2 if layout == "split" else 0)
    assert [view.name for view in (*found.training, *found.held_out)] == ["view_0", "view_1", "view_2"]


def test_training_image_whose_file_name_has_a_backslash_is_found(tmp_path: Path) -> None:
    """On Linux a file name may contain a backslash."""
    write_colmap_images(tmp_path, ring_cameras(2, 16, 12), POINTS, text=True)
    (tmp_path / "images/view_0.png").rename(tmp_path / "images/a\\view_0.png")
    listed = tmp_path / "sparse/0/images.txt"
    listed.write_text(listed.read_text().replace(" view_0", " a\\view_0"))
    assert len(ls.io.load_training_images(tmp_path, hold_out=0).training) == 2


def test_training_image_paths_with_backslashes_cannot_leave_the_folder(tmp_path: Path) -> None:
    """A path with backslashes is checked like a path with slashes."""
    write_nerfstudio_images(tmp_path / "set", ring_cameras(2, 16, 12))
    content = json.loads((tmp_path / "set/transforms.json").read_text())
    content["frames"][0]["file_path"] = "..\\view_0.png"
    (tmp_path / "set/transforms.json").write_text(json.dumps(content))
    with pytest.raises(ls.FormatError, match="not in its folder"):
        ls.io.load_training_images(tmp_path / "set")


def _marked(text: bytes) -> bytes:
    return b"\xef\xbb\xbf" + text


def _wide(text: bytes) -> bytes:
    return text.decode().encode("utf-16")


def _without_points(text: bytes) -> bytes:
    return b"\n".join(line for line in text.splitlines() if line.strip())


def _with_points(text: bytes) -> bytes:
    """Adds lines of 2D points that have as many words as the lines of images, whose names become numbers."""
    return text.replace(b"\n\n", b"\n1.5 2.5 7 3.5 4.5 8 5.5 6.5 9 1.5 2.5 -1\n")


@pytest.mark.parametrize("change", [_marked, _wide, _without_points, _with_points])
def test_colmap_text_may_have_a_byte_order_mark_and_no_points(tmp_path: Path, change: Callable[[bytes], bytes]) -> None:
    """Other programs write images.txt files in UTF-8 or UTF-16 with a mark, or without 2D points."""
    write_colmap_images(tmp_path, ring_cameras(4, 16, 12), POINTS, text=True)
    for name in ("images", "cameras", "points3D"):
        file = tmp_path / f"sparse/0/{name}.txt"
        file.write_bytes(
            change(file.read_bytes()) if name == "images" or change in (_marked, _wide) else file.read_bytes()
        )
    found = ls.io.load_training_images(tmp_path, hold_out=0)
    assert [view.name for view in found.training] == ["view_0", "view_1", "view_2", "view_3"]
    assert found.points is not None and len(found.points) == len(POINTS)


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 1e308, 1e200])
@pytest.mark.parametrize(("model", "count"), [(2, 1), (3, 2), (4, 4), (5, 4)])
def test_absurd_lens_distortion_of_training_images_is_refused(
    tmp_path: Path, value: float, model: int, count: int
) -> None:
    """Coefficients beyond any physical lens would overflow; the error is one line."""
    write_colmap_images(tmp_path, ring_cameras(2, 16, 12), POINTS)
    values = (*((45.0, 8.0, 6.0) if model < 4 else (45.0, 45.0, 8.0, 6.0)), *([value] * count))
    packed = struct.pack(f"<QiiQQ{len(values)}d", 1, 1, model, 16, 12, *values)
    (tmp_path / "sparse/0/cameras.bin").write_bytes(packed)
    with pytest.raises(ls.FormatError, match=r"images.bin: image 1 \(view_0.png\): camera distortion is"):
        ls.io.load_training_images(tmp_path)


def test_lens_distortion_coefficients_with_infinite_reciprocals_are_ignored(tmp_path: Path) -> None:
    """Coefficients whose reciprocals overflow give the rays of an undistorted lens."""
    camera = ring_cameras(1, 16, 12)[0]
    tiny = ring_cameras(1, 16, 12, distortion=(1e-320, 1e-310, -1e-320, 1e-300, 0.0, 0.0))[0]
    np.testing.assert_array_equal(tiny.ray_directions(), camera.ray_directions())
