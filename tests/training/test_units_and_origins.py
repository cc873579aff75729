"""Training is independent of the scene's unit and origin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.training.train import training_frame
from support.files.training_image_files import ring_cameras, write_colmap_images

UTM = np.array([500000.0, 5400000.0, 300.0])
CONFIG = ls.TrainConfig(iterations=60, cap=200, initial=120, sh_degree=1, coarse=0)
POINTS = np.random.default_rng(3).normal(size=(90, 3)) + np.array([1.0, 2.0, 3.0])


def moved(camera: ls.Camera, unit: float, origin: np.ndarray) -> ls.Camera:
    """Returns the camera in another unit and at another origin."""
    pose = np.array(camera.camera_from_world)
    pose[:3, 3] = unit * pose[:3, 3] - pose[:3, :3] @ origin
    return replace(camera, camera_from_world=pose)


def images(folder: Path, unit: float, origin: np.ndarray, *, points: bool = True) -> ls.io.TrainingImages:
    """Writes images of a ring of cameras around points in COLMAP's format, and loads them."""
    cameras = [moved(camera, unit, origin) for camera in ring_cameras(6, 32, 24)]
    known = unit * POINTS + origin if points else POINTS[:0]
    return ls.io.load_training_images(write_colmap_images(folder, cameras, known), hold_out=3)


def trained(images: ls.io.TrainingImages, config: ls.TrainConfig = CONFIG) -> ls.training.TrainResult:
    """Returns the result of a training on the CPU."""
    return ls.train(images, config, device="cpu")


@pytest.mark.parametrize("points", [True, False])
@pytest.mark.parametrize(
    ("unit", "origin"), [(1000.0, 0.0 * UTM), (1e-3, 0.0 * UTM), (1.0, UTM), (1000.0, 1000.0 * UTM)]
)
def test_training_is_independent_of_the_unit_and_origin_of_the_scene(
    tmp_path: Path, unit: float, origin: np.ndarray, points: bool
) -> None:
    """Gaussians are scaled and moved up to rounding, from millimetres to UTM coordinates."""
    first = trained(images(tmp_path / "a", 1.0, 0.0 * UTM, points=points))
    other = trained(images(tmp_path / "b", unit, origin, points=points))
    assert first.score is not None and other.score is not None
    assert other.score.psnr == pytest.approx(first.score.psnr, abs=0.05)
    before, after = first.gaussians, other.gaussians
    assert any(after.origin) is bool(origin.any())
    means = (after.means - (origin - np.array(after.origin))) / unit
    np.testing.assert_allclose(np.median(np.abs(means - before.means)), 0.0, atol=1e-5)
    np.testing.assert_allclose(np.median(after.scales / before.scales), unit, rtol=1e-3)
    np.testing.assert_allclose(np.median(np.abs(after.sh - before.sh)), 0.0, atol=1e-4)


@pytest.mark.parametrize("pipeline", ["trace", "unscented"])
def test_ray_and_unscented_training_are_independent_of_the_unit(tmp_path: Path, pipeline: str) -> None:
    """The held-out PSNR is equal for a scene in another unit, far from the origin."""
    backend = {"pipeline": ls.Pipeline.TRACE} if pipeline == "trace" else {"projection": ls.config.Projection.UNSCENTED}
    config = replace(CONFIG, iterations=20, **backend)
    scores = [
        trained(images(tmp_path / str(unit), unit, origin), config).score
        for unit, origin in ((1.0, 0.0 * UTM), (1000.0, 1000.0 * UTM))
    ]
    assert scores[0] is not None and scores[1] is not None
    assert scores[1].psnr == pytest.approx(scores[0].psnr, abs=0.05)


def test_training_of_images_in_map_coordinates_stores_the_origin_and_can_resume(tmp_path: Path) -> None:
    """The file stores the origin, and refined cameras are in world space."""
    far = images(tmp_path / "far", 1.0, UTM)
    config = replace(CONFIG, refine_poses=True)
    ls.train(far, config, output=tmp_path / "x.ply", device="cpu")
    loaded = ls.load(tmp_path / "x.ply")
    assert isinstance(loaded, ls.Gaussians)
    assert np.abs(np.array(loaded.origin) - UTM).max() < 10.0 and np.abs(loaded.means).max() < 100.0
    result = ls.train(far, config, output=tmp_path / "x.ply", device="cpu")
    np.testing.assert_array_equal(result.gaussians.means, loaded.means)
    assert result.cameras is not None
    for camera, view in zip(result.cameras, far.training, strict=True):
        assert np.linalg.norm(camera.eye - view.camera.eye) < 0.1


def test_extent_of_cameras_in_training_coordinates_is_equal_for_any_unit_of_the_images(tmp_path: Path) -> None:
    """Scale regularisation and position noise therefore have the same effect in any unit."""
    extents = []
    for unit, origin in ((1.0, 0.0 * UTM), (1e-3, 1e-3 * UTM), (1e5, 1e5 * UTM)):
        found = images(tmp_path / str(unit), unit, origin)
        extents.append(found.extent / training_frame(found).unit)
    np.testing.assert_allclose(extents, extents[0], rtol=1e-6)


def test_cameras_five_units_apart_far_from_the_origin_count_as_different_positions(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Cameras five units apart, five million units from the origin, are not at one position."""
    trained(images(tmp_path, 1.0, UTM), replace(CONFIG, iterations=1))
    assert "camera position" not in caplog.text and "same pose" not in caplog.text
