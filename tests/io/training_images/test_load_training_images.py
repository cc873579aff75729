"""Loading of training images: views, cameras, pixels, masks and splits of a folder."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.io.images.texture import read_texture, write_png
from lumisplat.io.training_images.loading import camera_target
from support.files.training_image_files import (
    change_frame,
    point_colors,
    render_image,
    ring_cameras,
    write_blender_images,
    write_colmap_images,
    write_nerfstudio_images,
)

BYTE = 0.5 / 255.0 + 1e-6
POINTS = np.random.default_rng(3).normal(size=(7, 3))


def same_view(camera: ls.Camera, other: ls.Camera) -> bool:
    """Returns whether two cameras have the same pose and intrinsics."""
    ours, theirs = ([one.width, one.height, one.fx, one.fy, one.cx, one.cy] for one in (camera, other))
    return bool(np.allclose(ours, theirs)) and np.allclose(camera.camera_from_world, other.camera_from_world)


@pytest.mark.parametrize("layout", ["transforms", "blender", "colmap", "colmap text", "colmap sparse", "colmap bare"])
def test_every_layout_of_training_images_gives_the_same_views(tmp_path, layout):
    """Poses, intrinsics, pixels and names are those that were written."""
    lens: dict[str, Any] = {"fy": 45.0, "cx": 20.0, "cy": 15.0} if layout == "blender" else {}
    cameras = ring_cameras(**lens)
    if layout == "transforms":
        write_nerfstudio_images(tmp_path, cameras)
    elif layout == "blender":
        write_blender_images(tmp_path, {"train": cameras}, alpha=None)
    else:
        model = {"colmap sparse": "sparse", "colmap bare": "."}.get(layout, "sparse/0")
        write_colmap_images(tmp_path, cameras, POINTS, text="text" in layout, model=model)
    found = ls.io.load_training_images(tmp_path, hold_out=0)
    assert [view.name for view in found.training] == [camera.name for camera in cameras]
    assert not found.held_out
    for view, camera in zip(found.training, cameras, strict=True):
        assert same_view(view.camera, camera) and view.camera.name == view.name
        assert view.pixels().dtype == np.float32
        np.testing.assert_allclose(view.pixels(), render_image(camera), atol=BYTE)
        assert view.alpha() is None and view.mask() is None


@pytest.mark.parametrize("text", [False, True])
def test_colmap_points_are_loaded_with_training_images(tmp_path, text):
    """Positions and colours are right for tracks of any length; other layouts have no points."""
    found = ls.io.load_training_images(write_colmap_images(tmp_path / "c", ring_cameras(), POINTS, text=text))
    assert found.points is not None and found.point_colors is not None
    np.testing.assert_allclose(found.points, POINTS, rtol=1e-6)
    np.testing.assert_allclose(found.point_colors, point_colors(7) / 255.0, atol=1e-6)
    none = ls.io.load_training_images(write_colmap_images(tmp_path / "n", ring_cameras(), POINTS[:0], text=text))
    assert none.points is None and none.point_colors is None
    assert ls.io.load_training_images(write_nerfstudio_images(tmp_path / "t", ring_cameras())).points is None


def test_every_eighth_training_image_by_name_is_held_out(tmp_path):
    """The first image and every eighth after it are held out, ordered by name and not by file order.

    With hold_out=0, all images are training images.
    """
    cameras = [replace(camera, name=f"v{k:02d}") for k, camera in enumerate(ring_cameras(18, 8, 6))]
    write_nerfstudio_images(tmp_path, cameras[::-1])
    names = [camera.name for camera in cameras]
    for step, expected in ((8, names[::8]), (3, names[::3]), (0, []), (50, names[:1])):
        found = ls.io.load_training_images(tmp_path, hold_out=step)
        assert [view.name for view in found.held_out] == expected
        assert [view.name for view in found.training] == [name for name in names if name not in expected]


def test_blender_test_file_defines_the_held_out_images(tmp_path):
    """Held out are the images of transforms_test.json, else those of transforms_val.json, else every eighth image.

    With hold_out=0, all images are training images.
    """
    cameras = ring_cameras(6, 16, 12)
    parts = {"train": cameras[:3], "test": cameras[3:5], "val": cameras[4:]}
    write_blender_images(tmp_path, parts)
    found = ls.io.load_training_images(tmp_path)
    assert [view.name for view in found.training] == ["view_0", "view_1", "view_2"]
    assert [view.path.parent.name for view in found.held_out] == ["test", "test"]
    (tmp_path / "transforms_test.json").unlink()
    assert [view.path.parent.name for view in ls.io.load_training_images(tmp_path).held_out] == ["val", "val"]
    assert not ls.io.load_training_images(tmp_path, hold_out=0).held_out
    (tmp_path / "transforms_val.json").unlink()
    assert [view.path.parent.name for view in ls.io.load_training_images(tmp_path).held_out] == ["train"]


def test_transparent_training_pixels_are_composited_over_background(tmp_path):
    """Pixels of alpha 0.4 are 0.4 image and 0.6 background; without a background, colours stay premultiplied."""
    camera = ring_cameras(3, 16, 12)
    write_blender_images(tmp_path, {"train": camera}, alpha=102 / 255)
    for background, behind in ((None, 0.0), ("transparent", 0.0), ("white", 1.0), ((0.0, 0.5, 1.0), (0.0, 0.5, 1.0))):
        view = ls.io.load_training_images(tmp_path, background=background, hold_out=0).training[0]
        expected = 0.4 * render_image(camera[0]) + 0.6 * np.array(behind)
        np.testing.assert_allclose(view.pixels(), expected, atol=2 * BYTE)
        alpha = view.alpha()
        assert alpha is not None
        np.testing.assert_allclose(alpha, 0.4, atol=1e-6)


@pytest.mark.parametrize(("scale", "size"), [(0.5, (20, 15)), (0.25, (10, 8)), (0.3, (12, 9)), (0.01, (1, 1))])
def test_downscaled_training_images_are_area_means(tmp_path, scale, size):
    """Means are taken of display-referred values; cameras show the same view at the new size."""
    cameras = ring_cameras(2)
    noise = [np.random.default_rng(k).uniform(size=(30, 40, 3)) for k in range(2)]
    write_nerfstudio_images(tmp_path, cameras, noise)
    view = ls.io.load_training_images(tmp_path, scale=scale, hold_out=0).training[0]
    assert (view.camera.width, view.camera.height) == size
    assert same_view(view.camera, cameras[0].scaled(*size))
    bytes_of = read_texture(view.path) / 255.0
    down = np.add.reduceat(np.repeat(bytes_of, size[1], axis=0), np.arange(size[1]) * 30, axis=0) / 30.0
    expected = np.add.reduceat(np.repeat(down, size[0], axis=1), np.arange(size[0]) * 40, axis=1) / 40.0
    np.testing.assert_allclose(view.pixels(), expected, atol=2 * BYTE)


@pytest.mark.parametrize("location", ["mask_path", "beside", "colmap"])
def test_black_pixels_of_training_masks_have_zero_weight(tmp_path, location):
    """Any other value has weight 1, as in nerfstudio and COLMAP. Masks are named by the file or found by image name."""
    cameras = ring_cameras(3)
    if location == "colmap":
        write_colmap_images(tmp_path, cameras, POINTS)
    else:
        write_nerfstudio_images(tmp_path, cameras)
    name = {"mask_path": "of/zero.png", "beside": "masks/view_0.png", "colmap": "masks/view_0.png.png"}[location]
    (tmp_path / name).parent.mkdir()
    grey = np.zeros((30, 40), np.uint8)
    grey[:15], grey[15:, :20] = 255, 1
    Image.fromarray(grey).save(tmp_path / name)
    if location == "mask_path":
        change_frame(tmp_path / "transforms.json", 0, mask_path=name)
    first, second = ls.io.load_training_images(tmp_path, hold_out=0).training[:2]
    mask = first.mask()
    assert mask is not None and second.mask() is None
    np.testing.assert_array_equal(mask, grey > 0)
    half = ls.io.load_training_images(tmp_path, hold_out=0, scale=1 / 3).training[0].mask()
    assert half is not None
    assert half[5, 6] == pytest.approx(0.5, abs=2 * BYTE) and half[9, 12] == 0.0 and half[0, 0] == 1.0


@pytest.mark.parametrize("scale", [0.5, 0.35])
def test_downscaling_training_images_excludes_masked_pixels(tmp_path, scale):
    """Masked pixels may have any colour; at the mask's edge, pixels are means over their unmasked area."""
    views = []
    for name, painted in (("a", 0), ("b", 255)):
        write_nerfstudio_images(tmp_path / name, ring_cameras(2))
        image = next(iter(sorted((tmp_path / name).rglob("view_0.*"))))
        hidden = np.zeros((30, 40), np.uint8)
        hidden[:13, :17] = 255
        (tmp_path / name / "masks").mkdir()
        Image.fromarray(255 - hidden).save(tmp_path / name / "masks" / "view_0.png")
        pixels = np.array(Image.open(image).convert("RGB"))
        pixels[hidden > 0] = painted
        Image.fromarray(pixels).save(image)
        views.append(ls.io.load_training_images(tmp_path / name, hold_out=0, scale=scale).training[0])
    mask = views[0].mask()
    assert mask is not None and ((mask > 0.0) & (mask < 1.0)).any()
    counts = mask > 0.01
    np.testing.assert_array_equal(views[0].pixels()[counts], views[1].pixels()[counts])
    assert (views[0].pixels() != views[1].pixels()).any()


def test_target_and_extent_of_a_ring_of_cameras_are_its_centre_and_1_1_radii(tmp_path):
    """The extent is 1.1 times the radius of a camera ring, the target its centre."""
    write_nerfstudio_images(tmp_path, ring_cameras(6, 8, 6))
    found = ls.io.load_training_images(tmp_path, hold_out=0)
    assert found.extent == pytest.approx(3.3)
    np.testing.assert_allclose(found.target, (1.0, 2.0, 3.0), atol=1e-9)


def test_common_target_of_cameras_with_parallel_axes_is_their_mean_position(tmp_path):
    """Parallel axes have no nearest point; the target of coincident cameras is their position."""
    camera = ring_cameras(7, 8, 6)[1]
    moved = [replace(camera, name=f"m{k}", camera_from_world=np.array(camera.camera_from_world)) for k in range(2)]
    pose = np.array(camera.camera_from_world)
    pose[0, 3] += 2.0
    moved[1] = replace(moved[1], camera_from_world=pose)
    write_nerfstudio_images(tmp_path / "a", moved)
    found = ls.io.load_training_images(tmp_path / "a", hold_out=0)
    np.testing.assert_allclose(found.target, 0.5 * (moved[0].eye + moved[1].eye), atol=1e-9)
    assert found.extent == pytest.approx(1.1)
    write_nerfstudio_images(tmp_path / "b", [moved[0], replace(moved[0], name="m2")])
    still = ls.io.load_training_images(tmp_path / "b", hold_out=0)
    assert still.extent == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(still.target, moved[0].eye, atol=1e-9)


def test_common_target_of_nearly_parallel_cameras_is_not_far_away():
    """Rounding errors of nearly parallel axes do not produce a far target."""
    rng = np.random.default_rng(5)
    for _ in range(100):
        eyes, axis = rng.normal(size=(3, 3)), rng.normal(size=3)
        cameras = [ls.Camera.look_at(eye, eye + axis, (0.1, 0.2, 1.0)) for eye in eyes]
        np.testing.assert_allclose(camera_target(cameras), eyes.mean(axis=0), atol=1e-6)


def test_training_image_cache_stays_within_its_byte_limit(tmp_path, monkeypatch):
    """Recently used images are cached, others decoded again with the same pixels; a limit of 0 caches no image."""
    from lumisplat.io.training_images import loading as module

    write_nerfstudio_images(tmp_path, ring_cameras(5))
    read: list[str] = []
    original = module.read_texture
    monkeypatch.setattr(module, "read_texture", lambda path: read.append(path.stem) or original(path))
    size = 40 * 30 * 3
    found = ls.io.load_training_images(tmp_path, hold_out=0, cache_bytes=2 * size + 100)
    cache = found.training[0]._cache
    first = [view.pixels() for view in found.training]
    assert len(read) == 5 and cache.held == 2 * size
    for k in (3, 0, 3):  # image 4, used before 3, is evicted for 0
        found.training[k].pixels()
    assert read[5:] == ["view_0"]
    for view, before in zip(found.training, first, strict=True):
        np.testing.assert_array_equal(view.pixels(), before)
        assert cache.held <= cache.limit
    assert len(read) > 9
    none = ls.io.load_training_images(tmp_path, hold_out=0, cache_bytes=0)
    del read[:]
    none.training[0].pixels()
    none.training[0].pixels()
    assert len(read) == 2 and none.training[0]._cache.held == 0


def test_missing_training_images_are_skipped_with_a_log_line(tmp_path, caplog):
    """The line counts the missing images and names the first ones."""
    cameras = ring_cameras(8, 8, 6)
    for folder in (
        write_nerfstudio_images(tmp_path / "t", cameras),
        write_colmap_images(tmp_path / "c", cameras, POINTS),
    ):
        for k in (1, 3, 4, 6):
            (folder / "images" / f"view_{k}.png").unlink()
        caplog.clear()
        found = ls.io.load_training_images(folder, hold_out=0)
        assert [view.name for view in found.training] == ["view_0", "view_2", "view_5", "view_7"]
        assert "4 of 8 images are missing in" in caplog.text
        assert "view_1.png, " in caplog.text and "view_4.png, ...): left out" in caplog.text


def test_undistortion_of_training_images_is_logged_once(tmp_path, caplog):
    """There is one line for all images, and none without distortion."""
    lens: dict[str, Any] = {"distortion": (0.05, -0.02, 0.0, 0.0, 0.001, 0.0)}
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        ls.io.load_training_images(write_nerfstudio_images(tmp_path / "bent", ring_cameras(4, **lens)))
        ls.io.load_training_images(write_nerfstudio_images(tmp_path / "straight", ring_cameras(4)))
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.endswith("/bent/transforms.json: 4 images of distorted or fisheye lenses are resampled to pinholes")


def test_training_images_in_subfolders_get_unique_names(tmp_path):
    """Equal file names in several folders get numbers."""
    cameras = ring_cameras(2, 8, 6)
    write_nerfstudio_images(tmp_path, cameras)
    for side in ("left", "right"):
        (tmp_path / "images" / side).mkdir()
        write_png(tmp_path / "images" / side / "a.png", render_image(cameras[0]))
    for index, side in enumerate(("right", "left")):
        change_frame(tmp_path / "transforms.json", index, file_path=f"images/{side}/a.png")
    views = ls.io.load_training_images(tmp_path, hold_out=0).training
    assert [(view.name, view.path.parent.name) for view in views] == [("a", "left"), ("a_2", "right")]


def test_training_images_outside_the_folder_are_refused_without_allow_outside(tmp_path):
    """By default a path outside the folder is refused."""
    folder = write_nerfstudio_images(tmp_path / "inner", ring_cameras(2, 8, 6))
    write_png(tmp_path / "outer.png", render_image(ring_cameras(2, 8, 6)[0]))
    change_frame(folder / "transforms.json", 0, file_path="../outer.png")
    with pytest.raises(ls.FormatError, match=r"names '../outer.png', which is not in its folder"):
        ls.io.load_training_images(folder)
    assert len(ls.io.load_training_images(folder, allow_outside=True, hold_out=0).training) == 2


@pytest.mark.parametrize("extension", [".png", ".jpg"])
def test_cameras_saved_beside_an_images_folder_are_a_training_set(tmp_path, extension):
    """`save_cameras` writes transforms.json; images and masks are found by camera name."""
    cameras = ring_cameras(4, 8, 6)
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    for camera in cameras:
        write_png(tmp_path / "images" / f"{camera.name}.png", render_image(camera))
        if extension != ".png":
            (tmp_path / "images" / f"{camera.name}.png").rename(tmp_path / "images" / f"{camera.name}{extension}")
        Image.new("L", (8, 6), 255).save(tmp_path / "masks" / f"{camera.name}.png")
    ls.save_cameras(tmp_path / "transforms.json", cameras)
    views = ls.io.load_training_images(tmp_path, hold_out=0).training
    assert [(view.name, view.path) for view in views] == [
        (camera.name, tmp_path / "images" / f"{camera.name}{extension}") for camera in cameras
    ]
    for view, camera in zip(views, cameras, strict=True):
        assert same_view(view.camera, camera) and view.mask() is not None
        np.testing.assert_allclose(view.pixels(), render_image(camera), atol=BYTE)


@pytest.mark.data
def test_downloaded_fox_images_load_with_7_held_out(data_dir):
    """The 50 images are of a phone, and undistortion leaves few pixels without data."""
    folder = Path(data_dir) / "photos" / "fox"
    found = ls.io.load_training_images(folder, scale=0.5)
    listed = json.loads((folder / "transforms.json").read_text())["frames"]
    assert (len(found.training), len(found.held_out)) == (len(listed) - 7, 7)
    view = found.held_out[0]
    assert (view.name, view.camera.width, view.camera.height, view.camera.is_distorted) == ("0001", 135, 240, False)
    assert view.pixels().shape == (240, 135, 3)
    mask = view.mask()
    assert mask is not None and 0.95 < mask.mean() < 1.0 and mask[120, 67] == 1.0
    assert 2.0 < found.extent < 8.0 and np.linalg.norm(found.target) < 1.0
