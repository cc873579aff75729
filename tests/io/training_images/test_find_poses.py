"""Pose estimation with COLMAP, if pycolmap is installed; poses of the fox are compared with its transforms.json."""

from __future__ import annotations

import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.io.images.texture import write_png

needs_colmap = pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap is not installed (extra poses)")


def test_find_poses_without_pycolmap_names_the_extra_to_install(tmp_path, monkeypatch):
    """The error is "pip install 'lumisplat[poses]'", and no file is written."""
    for k in range(2):
        write_png(tmp_path / f"{k}.png", np.full((8, 8, 3), 0.5))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ls.errors.MissingExtraError, match=r"find_poses needs .* pip install 'lumisplat\[poses\]'"):
        ls.io.find_poses(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"0.png", "1.png"}


def test_find_poses_refuses_unsuitable_folders(tmp_path):
    """There is no folder, no image or a single one, or a model exists already."""
    with pytest.raises(ls.errors.MissingFileError, match="nowhere: no such folder"):
        ls.io.find_poses(tmp_path / "nowhere")
    with pytest.raises(ls.FormatError, match="has no images, expected two or more"):
        ls.io.find_poses(tmp_path)
    write_png(tmp_path / "a.png", np.full((8, 8, 3), 0.5))
    with pytest.raises(ls.FormatError, match="has one image, expected two or more"):
        ls.io.find_poses(tmp_path)
    write_png(tmp_path / "b.png", np.full((8, 8, 3), 0.5))
    (tmp_path / "sparse").mkdir()
    with pytest.raises(ls.FormatError, match="sparse: already exists"):
        ls.io.find_poses(tmp_path)


@needs_colmap
def test_find_poses_refuses_images_without_texture(tmp_path):
    """The call leaves nothing behind, and has reported progress of every step."""
    (tmp_path / "images").mkdir()
    for k in range(3):
        write_png(tmp_path / "images" / f"grey {k}.png", np.full((60, 80, 3), 0.5))
    reported: list[tuple[str, float]] = []
    with pytest.raises(ls.FormatError, match="no poses were found for its 3 images: they have too little texture"):
        ls.io.find_poses(tmp_path, progress=lambda what, fraction: reported.append((what, fraction)))
    assert {path.name for path in tmp_path.iterdir()} == {"images"}
    steps = ["extracting features", "selecting pairs", "matching images", "finding poses"]
    assert list(dict.fromkeys(what.partition(",")[0] for what, _ in reported)) == steps
    assert all(0.0 <= fraction <= 1.0 for _, fraction in reported)


@needs_colmap
def test_find_poses_refuses_images_without_parallax(tmp_path):
    """Textured images from a camera that only rolls about its axis have no depth."""
    noise = np.random.default_rng(0).integers(0, 256, (60, 60, 3)).astype(np.uint8)
    wide = Image.fromarray(noise).resize((480, 480), Image.Resampling.NEAREST)
    (tmp_path / "images").mkdir()
    for k in range(4):
        rotated = wide.rotate(7.0 * k, Image.Resampling.BICUBIC).crop((80, 120, 400, 360))
        rotated.save(tmp_path / "images" / f"{k}.png")
    with pytest.raises(ls.FormatError, match="there is no parallax: move around the objects"):
        ls.io.find_poses(tmp_path, ordered=True)
    assert {path.name for path in tmp_path.iterdir()} == {"images"}


@needs_colmap
@pytest.mark.data
@pytest.mark.deep
def test_interrupted_find_poses_continues_with_stored_results(tmp_path, data_dir, caplog):
    """Ctrl C between any two progress reports keeps the results, and the next call does not compute them again."""
    source = Path(data_dir) / "photos" / "fox" / "images"
    (tmp_path / "images").mkdir()
    for image in sorted(source.iterdir())[10:20]:
        shutil.copy(image, tmp_path / "images")

    def until(step: str, fraction: float):
        def report(what: str, done: float) -> None:
            if what.startswith(step) and done >= fraction:
                raise KeyboardInterrupt

        return report

    for step, fraction, summary in (
        ("extracting features", 0.3, "features of 4 of 10 images, 0 matched pairs"),
        ("matching images", 0.5, "features of 10 of 10 images, 32 matched pairs"),
        ("finding poses", 0.5, "features of 10 of 10 images, 45 matched pairs"),
    ):
        caplog.clear()
        with pytest.raises(KeyboardInterrupt, match=f"poses.unfinished holds {summary}; the same command continues"):
            ls.io.find_poses(tmp_path, ordered=True, progress=until(step, fraction))
        assert {path.name for path in tmp_path.iterdir()} == {"images", "poses.unfinished"}
    assert ls.io.find_poses(tmp_path, ordered=True).is_dir()
    assert "continues from features of 10 of 10 images, 45 matched pairs" in caplog.text
    assert {path.name for path in tmp_path.iterdir()} == {"images", "sparse"}
    found = ls.load_cameras(tmp_path / "sparse" / "0")
    assert len(found) == 10 and len({(camera.fx, camera.fy) for camera in found}) == 1
    assert found[0].fx == found[0].fy == pytest.approx(343.9, rel=0.05)


@needs_colmap
@pytest.mark.data
@pytest.mark.deep
def test_find_poses_matches_the_given_poses_of_the_downloaded_fox_images(tmp_path, data_dir):
    """Poses match transforms.json up to a similarity, to 1 % of the camera path's length and 1 degree.

    COLMAP keeps the principal point at the image centre, which is off by 0.6 degrees. File names have spaces here.
    """
    source = Path(data_dir) / "photos" / "fox"
    (tmp_path / "images").mkdir()
    for image in sorted((source / "images").iterdir())[:24]:
        shutil.copy(image, tmp_path / "images" / f"a {image.name}")
    model = ls.io.find_poses(tmp_path)
    assert model == tmp_path / "sparse" / "0"
    expected = {f"a {camera.name}": camera for camera in ls.load_cameras(source / "transforms.json")}
    found = ls.load_cameras(model)
    assert len(found) >= 20
    assert found[0].fx == pytest.approx(expected[found[0].name].fx, rel=0.03)
    ours = np.stack([camera.eye for camera in found])
    theirs = np.stack([expected[camera.name].eye for camera in found])
    rotation, scale = similarity(ours, theirs)
    moved = scale * (ours - ours.mean(axis=0)) @ rotation.T + theirs.mean(axis=0)
    radius = np.linalg.norm(theirs - theirs.mean(axis=0), axis=1).max()
    assert np.linalg.norm(moved - theirs, axis=1).max() < 0.02 * radius
    for camera in found:
        between = camera.camera_from_world[:3, :3] @ rotation.T @ expected[camera.name].camera_from_world[:3, :3].T
        assert np.degrees(np.arccos(0.5 * (np.trace(between) - 1.0))) < 1.5
    read = ls.io.load_training_images(tmp_path)
    assert read.points is not None and len(read.points) > 500


def similarity(points: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns the rotation and scale that best align centred points with ``target`` (Umeyama 1991)."""
    a, b = points - points.mean(axis=0), target - target.mean(axis=0)
    u, sizes, v = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    return u @ np.diag(signs) @ v, float((sizes * signs).sum() / (a * a).sum())


def test_similarity_transform_between_point_sets_is_recovered():
    """The helper `similarity` returns the rotation and the scale that were applied."""
    camera = ls.Camera.look_at((1, 2, 3), (0, 0, 0))
    points = np.random.default_rng(1).normal(size=(9, 3))
    rotation = camera.camera_from_world[:3, :3]
    found, scale = similarity(points, 2.5 * points @ rotation.T + 4.0)
    np.testing.assert_allclose(found, rotation, atol=1e-12)
    assert scale == pytest.approx(2.5)
