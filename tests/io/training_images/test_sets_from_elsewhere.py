"""Sets of images as other programs lay them out: masks, test files, several models, Windows paths, odd text."""

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
def test_masks_are_found_by_the_names_that_programs_give_them(tmp_path: Path, name: str, folder: str) -> None:
    """Masks are found by the names that programs give them."""
    write_colmap_images(tmp_path, ring_cameras(3), POINTS)
    (tmp_path / folder).mkdir()
    for k in range(3):
        Image.fromarray(HALF).save(tmp_path / folder / name.format(f"view_{k}"))
    for view in ls.io.load_training_images(tmp_path, hold_out=0).training:
        mask = view.mask()
        assert mask is not None
        np.testing.assert_array_equal(mask, HALF > 0)


def test_a_mask_may_lie_beside_its_image_or_in_a_folder_like_that_of_the_image(tmp_path: Path) -> None:
    """A mask may lie beside its image or in a folder like that of the image."""
    write_nerfstudio_images(tmp_path, ring_cameras(3))
    content = json.loads((tmp_path / "transforms.json").read_text())
    for place in ("images/left", "masks/left"):
        (tmp_path / place).mkdir(parents=True)
    (tmp_path / "images/view_0.png").rename(tmp_path / "images/left/view_0.png")
    content["frames"][0]["file_path"] = "images/left/view_0.png"
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    Image.fromarray(HALF).save(tmp_path / "masks/left/view_0_mask.png")
    Image.fromarray(HALF).save(tmp_path / "images/view_1.png.mask.png")
    masks = {view.name: view.mask() for view in ls.io.load_training_images(tmp_path, hold_out=0).training}
    assert masks["view_0"] is not None and masks["view_1"] is not None and masks["view_2"] is None


def test_masks_that_match_no_image_or_some_only_are_counted_in_a_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Masks that match no image or some only are counted in a line."""
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
def test_a_test_file_without_its_images_does_not_stop_training(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, has_val: bool
) -> None:
    """What is held out instead is said: the images of the validation file, else some of those to learn from."""
    cameras = ring_cameras(6, 16, 12)
    write_blender_images(tmp_path, {"train": cameras[:4], "test": cameras[4:5], "val": cameras[5:]})
    shutil.rmtree(tmp_path / "test")
    if not has_val:
        shutil.rmtree(tmp_path / "val")
        (tmp_path / "transforms_val.json").unlink()
    found = ls.io.load_training_images(tmp_path)
    assert [view.path.parent.name for view in found.held_out] == ["val" if has_val else "train"]
    assert len(found.training) == (4 if has_val else 3)
    said = "the images of transforms_val.json are held out" if has_val else "some training images are held out"
    assert "none of its images exists" in caplog.text and said in caplog.text


def test_of_several_models_the_one_with_most_images_is_taken(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Whatever its number; the others are counted, and so are the images that the model does not have."""
    cameras = ring_cameras(7, 16, 12)
    for model, part in (("sparse/0", cameras[:2]), ("sparse/2", cameras[4:]), ("sparse/10", cameras[2:4])):
        write_colmap_images(tmp_path, part, POINTS, model=model, text=model == "sparse/2")
    found = ls.io.load_training_images(tmp_path, hold_out=0)
    assert [view.name for view in found.training] == ["view_4", "view_5", "view_6"]
    assert "has 3 models: 2 with 3 images is used; 0 with 2, 10 with 2 are not used" in caplog.text
    assert "4 of 7 images have no pose (view_0.png, view_1.png, view_2.png, ...)" in caplog.text
    assert [camera.name for camera in ls.load_cameras(tmp_path)] == ["view_4", "view_5", "view_6"]
    (tmp_path / "sparse/2/images.txt").write_bytes(b"\x00\xff")  # a damaged model is none to take
    assert len(ls.io.load_training_images(tmp_path, hold_out=0).training) == 2


def test_images_without_a_pose_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Images without a pose are counted."""
    cameras = ring_cameras(4, 16, 12)
    write_nerfstudio_images(tmp_path, cameras)
    content = json.loads((tmp_path / "transforms.json").read_text())
    del content["frames"][2]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    Image.fromarray(HALF).resize((16, 12)).save(tmp_path / "images/view_0.png.mask.png")
    assert len(ls.io.load_training_images(tmp_path, hold_out=0).training) == 3
    assert "1 of 4 images have no pose (view_2.png)" in caplog.text


@pytest.mark.parametrize("layout", ["transforms", "colmap", "split"])
def test_backslashes_are_slashes_where_no_file_has_that_name(tmp_path: Path, layout: str) -> None:
    """Backslashes are slashes where no file has that name."""
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


def test_a_file_whose_name_has_a_backslash_is_that_file(tmp_path: Path) -> None:
    """A file whose name has a backslash is that file."""
    write_colmap_images(tmp_path, ring_cameras(2, 16, 12), POINTS, text=True)
    (tmp_path / "images/view_0.png").rename(tmp_path / "images/a\\view_0.png")
    listed = tmp_path / "sparse/0/images.txt"
    listed.write_text(listed.read_text().replace(" view_0", " a\\view_0"))
    assert len(ls.io.load_training_images(tmp_path, hold_out=0).training) == 2


def test_backslashes_do_not_lead_out_of_the_folder(tmp_path: Path) -> None:
    """Backslashes do not lead out of the folder."""
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
    """Lines of points that are as long as those of images, as images with numbers for names would be."""
    return text.replace(b"\n\n", b"\n1.5 2.5 7 3.5 4.5 8 5.5 6.5 9 1.5 2.5 -1\n")


@pytest.mark.parametrize("change", [_marked, _wide, _without_points, _with_points])
def test_text_of_colmap_may_have_a_mark_and_may_lack_points(tmp_path: Path, change: Callable[[bytes], bytes]) -> None:
    """Text of colmap may have a mark and may lack points."""
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
def test_distortion_beyond_any_lens_is_one_line(tmp_path: Path, value: float, model: int, count: int) -> None:
    """Distortion beyond any lens is one line."""
    write_colmap_images(tmp_path, ring_cameras(2, 16, 12), POINTS)
    values = (*((45.0, 8.0, 6.0) if model < 4 else (45.0, 45.0, 8.0, 6.0)), *([value] * count))
    packed = struct.pack(f"<QiiQQ{len(values)}d", 1, 1, model, 16, 12, *values)
    (tmp_path / "sparse/0/cameras.bin").write_bytes(packed)
    with pytest.raises(ls.FormatError, match=r"images.bin: image 1 \(view_0.png\): camera distortion is"):
        ls.io.load_training_images(tmp_path)


def test_distortion_that_moves_no_point_is_none(tmp_path: Path) -> None:
    """Coefficients whose reciprocals overflow draw the picture of a lens without them."""
    camera = ring_cameras(1, 16, 12)[0]
    tiny = ring_cameras(1, 16, 12, distortion=(1e-320, 1e-310, -1e-320, 1e-300, 0.0, 0.0))[0]
    np.testing.assert_array_equal(tiny.ray_directions(), camera.ray_directions())
