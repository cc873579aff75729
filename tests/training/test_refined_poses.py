"""Camera poses are refined during training."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.transforms import rigid_from_twist, twist_from_rigid
from lumisplat.training import train
from lumisplat.training.backends import TrainingRaster
from lumisplat.training.exposure_and_pose import Poses, twist_gradient
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TrainingView
from support.files.training_image_files import change_frame, ring_cameras, write_nerfstudio_images
from support.scenes.training_scenes import BACKGROUND, known_gaussians, known_parameters, views, write_training_folder

STILL = ls.config.LearningRates(
    means=1e-12, means_last=1e-13, rotations=0.0, log_scales=0.0, logits=0.0, sh=0.0, poses=1e-2, poses_last=3e-4
)
"""Learning rates that move camera poses and leave the Gaussians nearly unchanged."""
CONFIG = ls.TrainConfig(iterations=600, cap=30, sh_degree=1, refine_poses=True, rates=STILL)


def moved(given: list[TrainingView], degrees: float, shift: float) -> list[TrainingView]:
    """Returns views with perturbed cameras; the mean perturbation is 0."""
    twists = np.random.default_rng(5).normal(size=(len(given), 6)) * np.repeat([np.radians(degrees), shift], 3)
    twists -= twists.mean(axis=0)
    return [
        replace(view, camera=replace(view.camera, camera_from_world=view.camera.camera_from_world @ motion))
        for view, motion in zip(given, map(rigid_from_twist, twists), strict=True)
    ]


def started(given: list[TrainingView], config: ls.TrainConfig) -> Trainer:
    """Returns a trainer that starts with the true Gaussians."""
    one = Trainer(given, config, background=BACKGROUND, points=known_gaussians().means, device="cpu")
    one._upload(known_parameters())
    return one


def errors(poses: np.ndarray, true: list[TrainingView]) -> np.ndarray:
    """Returns root mean square errors of rotation, degrees, and eye position, scene units."""
    truth = np.stack([view.camera.camera_from_world for view in true])
    rotations = [twist_from_rigid(pose @ np.linalg.inv(one))[:3] for pose, one in zip(poses, truth, strict=True)]
    eyes = np.linalg.inv(poses)[:, :3, 3] - np.linalg.inv(truth)[:, :3, 3]
    return np.sqrt([np.sum(np.square(np.degrees(rotations)), axis=1).mean(), np.sum(eyes**2, axis=1).mean()])


def test_training_reduces_errors_of_perturbed_camera_poses_to_a_fifth() -> None:
    """Errors of about 1 degree and 1 % of the distance shrink to a fifth, with known Gaussians."""
    true = views(12)
    one = started(moved(true, 1.0, 0.03), CONFIG)
    assert one.poses is not None
    before = errors(one.poses.values, true)
    assert before[0] > 1.0 and before[1] > 0.04
    for _ in range(CONFIG.iterations):
        one.step()
    after = errors(one.poses.values, true)
    assert (after < before / 5.0).all(), (before, after)


@pytest.mark.parametrize(
    "drawn_by",
    [{}, {"pipeline": ls.Pipeline.TRACE}, {"projection": ls.config.Projection.UNSCENTED}],
    ids=["splats", "ray traced", "unscented"],
)
def test_training_gradients_for_camera_poses_match_central_differences(drawn_by: dict[str, Any]) -> None:
    """The reference moves the camera and compares the losses of the trainer's frames."""
    given = moved(views(2), 1.0, 0.03)
    one = started(given, replace(CONFIG, **drawn_by))
    camera, wanted = given[0].camera, given[0].read()
    raster, loss = one._backend, one._loss
    target = loss.load(wanted.color, None, None)

    def total(pose: np.ndarray) -> float:
        pixels = raster.draw(replace(camera, camera_from_world=pose), 1, BACKGROUND)
        loss.differentiate(camera.image_size, pixels, target)
        return loss.read(camera.image_size).total

    pixels = raster.draw(camera, 1, BACKGROUND)
    raster.backward(pixels, loss.differentiate(camera.image_size, pixels, target))
    if isinstance(raster, TrainingRaster):
        raster.sum_pose()
    pose = np.asarray(camera.camera_from_world)
    found = twist_gradient(pose, raster.by_pose(camera))
    step = 1e-3
    slopes = [
        (total(rigid_from_twist(step * axis) @ pose) - total(rigid_from_twist(-step * axis) @ pose)) / (2.0 * step)
        for axis in np.eye(6)
    ]
    np.testing.assert_allclose(found, slopes, atol=0.03 * np.abs(slopes).max())


def test_mean_correction_of_refined_camera_poses_stays_zero() -> None:
    """Rotation matrices stay orthogonal after many steps."""
    poses = Poses.of([view.camera for view in views(5)], 3.0)
    rng = np.random.default_rng(0)
    for _ in range(9):
        for number in rng.permutation(5):
            poses.update(int(number), rng.normal(1.0 + number, 0.5, (3, 4)), 1e-3)
    motions = np.linalg.inv(poses.initial) @ poses.values
    twists = np.array([twist_from_rigid(motion) for motion in motions])
    np.testing.assert_allclose(twists.mean(axis=0), 0.0, atol=1e-4 * np.abs(twists).max())
    assert np.abs(twists).max() > 1e-3
    rotations = poses.values[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.repeat(np.eye(3)[None], 5, axis=0), atol=1e-12
    )


def test_poses_and_exposures_of_a_resumed_training_equal_uninterrupted_ones_to_the_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Resumed results have the same bits, in the capture, the poses file and the exposures file."""
    monkeypatch.setattr(
        train, "time", SimpleNamespace(monotonic=itertools.count().__next__)
    )  # one second per iteration
    folder = write_training_folder(tmp_path / "set")
    config = ls.TrainConfig(iterations=60, cap=100, initial=80, sh_degree=1, exposures=True, refine_poses=True)
    whole = ls.train(folder, config, output=tmp_path / "a.ply", device="cpu")
    parts: list[ls.training.TrainResult] = []
    while not parts or not parts[-1].is_finished:
        parts.append(ls.train(folder, config, output=tmp_path / "b.ply", stop_after=25.0, device="cpu"))
    assert len(parts) > 1 and (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    for name in ("exposures.json", "poses.json"):
        assert (tmp_path / "a.training" / name).read_bytes() == (tmp_path / "b.training" / name).read_bytes()
    assert whole.cameras is not None and whole.exposures is not None
    given = {camera.name: camera for camera in ls.load_cameras(folder / "transforms.json")}
    saved = ls.load_cameras(tmp_path / "a.training" / "poses.json")
    assert [camera.name for camera in saved] == [camera.name for camera in whole.cameras] == list(whole.exposures)
    for one, camera in zip(saved, whole.cameras, strict=True):
        np.testing.assert_allclose(one.camera_from_world, camera.camera_from_world, atol=1e-9)
        assert np.abs(camera.camera_from_world - given[camera.name].camera_from_world).max() > 1e-4


def test_refined_poses_are_written_to_one_file_per_camera_model(tmp_path: Path) -> None:
    """The images of a fisheye and of pinhole cameras are trained without undistortion."""
    folder = write_nerfstudio_images(tmp_path / "set", ring_cameras(4))
    change_frame(folder / "transforms.json", 2, camera_model="OPENCV_FISHEYE")
    config = replace(CONFIG, iterations=2, sh_degree=0, projection=ls.config.Projection.UNSCENTED)
    result = ls.train(folder, config, output=tmp_path / "a.ply", device="cpu")
    files = sorted(path.name for path in (tmp_path / "a.training").glob("poses*"))
    assert result.cameras is not None and files == ["poses-fisheye.json", "poses-pinhole.json"]
    for name in files:
        saved = ls.load_cameras(tmp_path / "a.training" / name)
        expected = [camera for camera in result.cameras if f"poses-{camera.model.value}.json" == name]
        assert [camera.name for camera in saved] == [camera.name for camera in expected]
        assert all(one.model is camera.model for one, camera in zip(saved, expected, strict=True))


@pytest.mark.parametrize(
    ("change", "what"),
    [({"camera_from_world_end": np.eye(4)}, "a rolling shutter"), ({"aperture": 0.1}, "an aperture")],
)
def test_pose_refinement_refuses_cameras_with_shutter_motion_or_aperture(change: dict[str, Any], what: str) -> None:
    """A rolling shutter or an aperture is not described by one pose."""
    some = [replace(camera, name="left") for camera in ring_cameras(2)]
    with pytest.raises(ls.SceneError, match=rf"^the camera of left has {what}.*: turn off TrainConfig\.refine_poses$"):
        Poses.of([some[0], replace(some[1], **change)], 3.0)


def test_training_with_all_loss_terms_has_the_same_bits_on_any_number_of_threads() -> None:
    """The training uses all optional parameters and loss terms."""
    config = ls.TrainConfig(
        iterations=40,
        cap=60,
        initial=60,
        sh_degree=1,
        exposures=True,
        refine_poses=True,
        random_background=True,
        flatness=1.0,
        normals=0.1,
        depth_spread=0.1,
    )
    found: list[dict[str, np.ndarray]] = []
    for threads in (1, 2, 5):
        one = Trainer(views(4), config, background=BACKGROUND, device="cpu", threads=threads)
        for _ in range(config.iterations):
            one.step()
        state = one.checkpoint
        found.append({**state.parameters.values, **state.per_image, "weights": one.largest_weights()})
    for other in found[1:]:
        for name, values in found[0].items():
            np.testing.assert_array_equal(other[name], values, err_msg=name)
    assert np.abs(found[0]["exposures"] - np.eye(3, 4)).max() > 1e-3
