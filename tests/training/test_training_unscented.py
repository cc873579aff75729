"""Training by the unscented transform uses distorted images without undistortion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.runtime.buffers import device_array
from lumisplat.training.parameters import SceneScale, random_points
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TargetPixels, TrainingView
from support.files.training_image_files import write_nerfstudio_images
from support.scenes.training_scenes import BACKGROUND, cameras, known_gaussians

CONFIG = ls.TrainConfig(
    iterations=400, cap=150, initial=80, sh_degree=1, coarse=0, seed=3, projection=ls.config.Projection.UNSCENTED
)
FRAMES = ls.RenderConfig(
    raster=ls.RasterConfig(projection=ls.config.Projection.UNSCENTED), background=BACKGROUND, lighting=False
)
TRACED = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, background=BACKGROUND, lighting=False)
LENSES: dict[str, dict[str, Any]] = {
    "barrel": {"distortion": (-0.3, 0.05, 0.0, 0.0, 0.005, -0.003)},
    "fisheye": {"model": ls.CameraModel.FISHEYE, "distortion": (0.1, -0.02, 0.01, 0.0, 0.0, 0.0)},
}


def lenses(count: int, kind: str = "fisheye", size: int = 40) -> list[ls.Camera]:
    """Returns cameras with a distorted lens around the known Gaussians."""
    focal = 1.4 * size
    change = {"fx": focal, "fy": focal, **LENSES[kind]}
    return [replace(camera, name=f"{n:02d}", **change) for n, camera in enumerate(cameras(count, size))]


def seen(of: ls.Gaussians, some: list[ls.Camera], config: ls.RenderConfig = TRACED) -> list[np.ndarray]:
    """Returns images of Gaussians from cameras, ray traced by default."""
    renderer = ls.create_renderer(config, "cpu")
    return [np.array(renderer.render(ls.Scene([of]), camera).color, np.float32) for camera in some]


def trainer(config: ls.TrainConfig, some: list[ls.Camera], threads: int | None = None) -> Trainer:
    """Returns a trainer before its first iteration, with ray-traced images of the known Gaussians."""
    views = [
        TrainingView(camera.name, camera, lambda color=color: TargetPixels(color))
        for camera, color in zip(some, seen(known_gaussians(), some), strict=True)
    ]
    return Trainer(views, config, background=BACKGROUND, device="cpu", threads=threads)


def held_out_psnr(of: Trainer, some: list[ls.Camera]) -> float:
    """Returns the PSNR of held-out unscented frames against ray-traced frames of the known Gaussians."""
    pairs = zip(seen(of.gaussians(), some, FRAMES), seen(known_gaussians(), some), strict=True)
    return float(np.mean([ls.metrics.psnr(np.clip(one, 0.0, 1.0), np.clip(other, 0.0, 1.0)) for one, other in pairs]))


def test_unscented_training_frame_equals_the_frame_of_the_renderer() -> None:
    """The frames agree after the Gaussians have moved or been replaced."""
    one, camera = trainer(CONFIG, lenses(4)), lenses(6)[5]
    for _ in range(30):
        one.step()
    check_frame(one, camera)
    state = one.checkpoint
    fewer = {name: values[:50] for name, values in state.record.items()}
    one.restore(replace(state, parameters=state.parameters.rows(np.arange(50)), record=fewer))
    check_frame(one, camera)
    one.step()
    check_frame(one, camera)


def check_frame(one: Trainer, camera: ls.Camera) -> None:
    """Compares the trainer's frame with that of a renderer."""
    pixels = one._backend.draw(camera, 1, BACKGROUND)
    expected = seen(one.gaussians(), [camera], FRAMES)[0]
    shown = device_array(pixels.color).numpy().reshape(expected.shape)
    assert np.abs(shown - expected).max() < 2e-6


@pytest.mark.parametrize("kind", LENSES)
def test_unscented_training_raises_the_psnr_of_held_out_views_by_4_db(kind: str) -> None:
    """200 small iterations gain 4 dB."""
    one, others = trainer(CONFIG, lenses(8, kind)), lenses(40, kind)[33:36]
    before = held_out_psnr(one, others)
    for _ in range(200):
        one.step()
    losses = [loss.total for _, loss in one.take_losses()]
    assert np.mean(losses[-40:]) < 0.6 * np.mean(losses[:20])
    assert held_out_psnr(one, others) > before + 4.0


@pytest.mark.deep
@pytest.mark.parametrize("kind", LENSES)
def test_unscented_training_recovers_ray_traced_images_of_gaussians_to_40_db(kind: str) -> None:
    """32 images through a lens give more than 40 dB on held-out views."""
    config = replace(CONFIG, iterations=6000, cap=400, initial=400)
    views = lenses(40, kind, 64)
    one = trainer(config, views[:32])
    for _ in range(config.iterations):
        one.step()
    assert held_out_psnr(one, views[33:]) > 40.0


def test_initial_random_points_lie_within_the_view_of_a_fisheye() -> None:
    """A fisheye of 240 degrees gets points all around, near the distance of its target."""
    wide = [replace(camera, fx=9.0, fy=9.0, model=ls.CameraModel.FISHEYE) for camera in cameras(6)]
    around = SceneScale.of(wide)
    points = random_points(wide, around, 4000, np.random.default_rng(1))
    distances = np.array([np.linalg.norm(points - camera.eye, axis=1) for camera in wide])
    assert distances.min() > 0.05 * around.distance
    views = [points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3] for camera in wide]
    behind = np.all([view[:, 2] < 0.0 for view in views[:1]], axis=0)
    assert behind.mean() > 0.1
    pinholes = random_points(cameras(6), around, 4000, np.random.default_rng(1))
    seen_by = [
        (np.abs(view[:, :2] / view[:, 2:]).max(axis=1) < np.tan(0.3) + 1e-6) & (view[:, 2] > 0.0)
        for view in (pinholes @ c.camera_from_world[:3, :3].T + c.camera_from_world[:3, 3] for c in cameras(6))
    ]
    assert np.any(seen_by, axis=0).all()


def test_unscented_training_has_the_same_bits_on_any_number_of_threads() -> None:
    """Gradients are summed in a fixed order."""
    made = [trainer(CONFIG, lenses(4), threads) for threads in (1, 2, 5)]
    for one in made:
        for _ in range(40):
            one.step()
    first = made[0].checkpoint.parameters
    for other in made[1:]:
        for name, values in other.checkpoint.parameters.values.items():
            np.testing.assert_array_equal(values, first.values[name], err_msg=name)


def test_unscented_training_uses_fisheye_images_without_undistortion(tmp_path: Path) -> None:
    """The held-out score is measured through the lens."""
    some = lenses(9)
    folder = tmp_path / "set"
    write_nerfstudio_images(folder, some, [np.clip(frame, 0.0, 1.0) for frame in seen(known_gaussians(), some)])
    result = ls.train(folder, replace(CONFIG, iterations=40), output=tmp_path / "a.ply", device="cpu")
    assert result.score is not None and result.is_finished
    black = replace(FRAMES, background=(0.0, 0.0, 0.0))
    asset = ls.load(tmp_path / "a.ply")
    assert isinstance(asset, ls.Gaussians)
    shown, held_out_image = (
        seen(asset, some[:1], black)[0],
        ls.io.load_training_images(folder, straighten=False).held_out[0],
    )
    assert held_out_image.camera.is_distorted
    found = ls.metrics.psnr(np.clip(shown, 0.0, 1.0), held_out_image.pixels())
    assert result.score.of_views[held_out_image.name] == pytest.approx(found, abs=0.05)


def test_unscented_training_refuses_incompatible_settings() -> None:
    """The error has one line."""
    refused: list[tuple[dict[str, Any], str]] = [
        ({"pipeline": "trace"}, r"projection is unscented, which is for Pipeline\.RASTER"),
        ({"kernel_degree": 4}, "kernel_degree is 4, which needs rays"),
        ({"densification": "adaptive"}, "densification is adaptive, which needs splats"),
    ]
    for settings, problem in refused:
        with pytest.raises(ls.ConfigError, match=problem):
            ls.TrainConfig(projection=ls.config.Projection.UNSCENTED, **settings)
