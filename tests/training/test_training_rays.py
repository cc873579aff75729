"""Training by ray tracing accepts any kernel degree and any camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.runtime.buffers import device_array
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TargetPixels, TrainingView
from support.files.training_image_files import write_nerfstudio_images
from support.scenes.training_scenes import BACKGROUND, cameras, known_gaussians

CONFIG = ls.TrainConfig(
    iterations=400, cap=150, initial=80, sh_degree=1, coarse=0, seed=3, pipeline=ls.Pipeline.TRACE, kernel_degree=4
)
FRAMES = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, background=BACKGROUND, lighting=False)


def fisheyes(count: int) -> list[ls.Camera]:
    """Returns distorted fisheye cameras around the known Gaussians."""
    lens: dict[str, Any] = {"model": ls.CameraModel.FISHEYE, "distortion": (0.1, -0.02, 0.01, 0.0, 0.0, 0.0)}
    return [replace(camera, fx=55.0, fy=55.0, name=f"{n:02d}", **lens) for n, camera in enumerate(cameras(count))]


def seen(of: ls.Gaussians, some: list[ls.Camera]) -> list[np.ndarray]:
    """Returns ray-traced images of Gaussians from cameras."""
    renderer = ls.create_renderer(FRAMES, "cpu")
    return [np.array(renderer.render(ls.Scene([of]), camera).color, np.float32) for camera in some]


def trainer(config: ls.TrainConfig, some: list[ls.Camera], threads: int | None = None) -> Trainer:
    """Returns a trainer before its first iteration, with ray-traced images of the known Gaussians."""
    truth = replace(known_gaussians(), kernel_degree=config.kernel_degree)
    views = [
        TrainingView(camera.name, camera, lambda color=color: TargetPixels(color))
        for camera, color in zip(some, seen(truth, some), strict=True)
    ]
    return Trainer(views, config, background=BACKGROUND, device="cpu", threads=threads)


def held_out_psnr(of: Trainer, some: list[ls.Camera]) -> float:
    """Returns the PSNR on views other than the training views."""
    truth = replace(known_gaussians(), kernel_degree=of.config.kernel_degree)
    pairs = zip(seen(of.gaussians(), some), seen(truth, some), strict=True)
    return float(np.mean([ls.metrics.psnr(np.clip(one, 0.0, 1.0), np.clip(other, 0.0, 1.0)) for one, other in pairs]))


def test_ray_traced_training_frame_equals_the_frame_of_the_renderer() -> None:
    """The frames agree after the Gaussians have moved and the BVH is refitted, and after they were replaced."""
    one, camera = trainer(CONFIG, cameras(4, 20)), cameras(6)[5]
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
    expected = seen(one.gaussians(), [camera])[0]
    shown = device_array(pixels.color).numpy().reshape(expected.shape)
    assert np.abs(shown - expected).max() < 2e-6


def test_training_by_rays_raises_the_psnr_of_held_out_views_by_4_db() -> None:
    """200 small iterations gain 4 dB."""
    one, others = trainer(CONFIG, cameras(8, 32)), cameras(40)[33:36]
    before = held_out_psnr(one, others)
    for _ in range(200):
        one.step()
    losses = [loss.total for _, loss in one.take_losses()]
    assert np.mean(losses[-40:]) < 0.6 * np.mean(losses[:20])
    assert held_out_psnr(one, others) > before + 4.0
    assert one.gaussians().kernel_degree == 4


@pytest.mark.deep
@pytest.mark.parametrize("kind", ["pinhole", "fisheye"])
def test_training_by_rays_recovers_images_of_gaussians_of_kernel_degree_4_to_40_db(kind: str) -> None:
    """32 ray-traced images give more than 40 dB on held-out views."""
    config = replace(CONFIG, iterations=6000, cap=400, initial=400)
    views = fisheyes(40) if kind == "fisheye" else cameras(40, 64)
    one = trainer(config, views[:32])
    for _ in range(config.iterations):
        one.step()
    assert held_out_psnr(one, views[33:]) > 40.0


def test_training_by_rays_has_the_same_bits_on_any_number_of_threads() -> None:
    """Gradients are summed, and the BVH is refitted, in a fixed order."""
    made = [trainer(CONFIG, cameras(4, 20), threads) for threads in (1, 2, 5)]
    for one in made:
        for _ in range(40):
            one.step()
    first = made[0].checkpoint.parameters
    for other in made[1:]:
        for name, values in other.checkpoint.parameters.values.items():
            np.testing.assert_array_equal(values, first.values[name], err_msg=name)


def test_training_by_rays_uses_fisheye_images_without_undistortion(tmp_path: Path) -> None:
    """The capture file stores its kernel degree; pixels without a ray do not count."""
    some = [replace(camera, fx=2.5, fy=2.5) if n == 4 else camera for n, camera in enumerate(fisheyes(9))]
    frames = [np.clip(frame, 0.0, 1.0) for frame in seen(replace(known_gaussians(), kernel_degree=4), some)]
    folder = tmp_path / "set"
    write_nerfstudio_images(folder, some, frames)
    view = ls.io.load_training_images(folder, straighten=False).training[3]
    assert view.camera.model is ls.CameraModel.FISHEYE and view.camera.is_distorted
    np.testing.assert_allclose(view.pixels(), frames[4], atol=0.003)
    mask = view.mask()
    assert mask is not None and 0.0 < mask.mean() < 1.0
    np.testing.assert_array_equal(mask > 0.0, some[4].ray_directions().any(axis=2))
    result = ls.train(folder, replace(CONFIG, iterations=40), output=tmp_path / "a.ply", device="cpu")
    assert result.score is not None and result.is_finished
    asset = ls.load(tmp_path / "a.ply")
    assert isinstance(asset, ls.Gaussians) and asset.kernel_degree == 4
    black = replace(FRAMES, background=(0.0, 0.0, 0.0))
    shown = ls.render(ls.Scene([asset]), some[0], black, device="cpu").color
    assert result.score.of_views["00"] == pytest.approx(ls.metrics.psnr(np.clip(shown, 0.0, 1.0), frames[0]), abs=0.05)


def test_training_by_rays_refuses_incompatible_settings(tmp_path: Path) -> None:
    """The error has one line."""
    refused: list[tuple[dict[str, Any], str]] = [
        ({"kernel_degree": 4}, "kernel_degree is 4, which needs rays: use Pipeline.TRACE"),
        ({"kernel_degree": 6, "pipeline": "trace"}, "kernel_degree is 6, expected"),
        ({"pipeline": "path"}, "pipeline is 'path', expected 'raster' or 'trace'"),
        ({"pipeline": "trace", "densification": "adaptive"}, "densification is adaptive, which needs splats"),
    ]
    for settings, problem in refused:
        with pytest.raises(ls.ConfigError, match=problem):
            ls.TrainConfig(**settings)
    with pytest.raises(ls.ConfigError, match=r"a\.spz, but \.spz cannot store kernel degree 4: use \.ply$"):
        ls.train(tmp_path, CONFIG, output=tmp_path / "a.spz", device="cpu")
