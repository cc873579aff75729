"""Gaussians of small blending weight are pruned at the end of training."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.transforms import rigid_from_twist
from lumisplat.training.parameters import TrainedParameters
from lumisplat.training.trainer import Trainer
from support.scenes.training_scenes import BACKGROUND, known_gaussians, known_parameters, views, write_training_folder


@pytest.mark.parametrize("threads", [1, 5])
def test_largest_blending_weight_of_each_rasterised_gaussian_matches_rendered_features(threads: int) -> None:
    """The reference renders one feature channel per Gaussian; a Gaussian that no camera sees has weight 0."""
    given = views(3, 45)
    parameters = known_parameters().rows(np.arange(30))
    parameters.values["means"][4] = (0.0, 50.0, 0.0)
    parameters.values["logits"][5] = -4.0
    config = ls.TrainConfig(cap=30, sh_degree=1)
    one = Trainer(given, config, background=BACKGROUND, points=known_gaussians().means, device="cpu", threads=threads)
    one._upload(TrainedParameters.new(parameters.values))
    found = one.largest_weights()
    renderer, expected = ls.DifferentiableRenderer(ls.RenderConfig(), "cpu"), np.zeros(30)
    for view in given:
        renderer.render(ls.Scene([one.gaussians()]), view.camera)
        expected = np.maximum(expected, renderer.render_features(np.eye(30)).max(axis=(0, 1)))
    np.testing.assert_allclose(found, expected, atol=2e-6)
    assert found[4] == 0.0 and found[5] < 0.02 and found.max() > 0.3


LENS = {"model": ls.CameraModel.FISHEYE, "distortion": (0.1, -0.02, 0.01, 0.0, 0.0, 0.0), "fx": 45.0, "fy": 40.0}
ALONG = ls.RasterConfig(projection=ls.config.Projection.UNSCENTED)


@pytest.mark.parametrize(
    ("settings", "frames", "lens", "moves"),
    [
        ({"pipeline": ls.Pipeline.TRACE, "kernel_degree": 4}, {"pipeline": ls.Pipeline.TRACE}, {}, False),
        ({"projection": ls.config.Projection.UNSCENTED}, {"raster": ALONG}, {}, False),
        ({"projection": ls.config.Projection.UNSCENTED}, {"raster": ALONG}, LENS, True),
    ],
    ids=["ray traced", "unscented", "unscented, moving fisheye"],
)
def test_largest_blending_weight_of_each_ray_traced_gaussian_matches_rendered_frames(
    settings: dict[str, Any], frames: dict[str, Any], lens: dict[str, Any], moves: bool
) -> None:
    """A frame with one white Gaussian among black ones is the image of its weights."""
    given = [replace(view, camera=replace(view.camera, **lens)) for view in views(2, 40)]
    if moves:
        shift = rigid_from_twist(np.array([0.0, 0.02, 0.0, 0.3, 0.1, 0.0]))
        ends = [shift @ view.camera.camera_from_world for view in given]
        given = [
            replace(view, camera=replace(view.camera, camera_from_world_end=end))
            for view, end in zip(given, ends, strict=True)
        ]
    parameters = known_parameters().rows(np.arange(8))
    parameters.values["means"][4] = (0.0, 50.0, 0.0)
    config = ls.TrainConfig(cap=8, sh_degree=1, **settings)
    one = Trainer(given, config, points=known_gaussians().means[:8], device="cpu", threads=2)
    one._upload(TrainedParameters.new(parameters.values))
    found, expected = one.largest_weights(), np.zeros(8)
    renderer = ls.create_renderer(ls.RenderConfig(**frames, lighting=False), "cpu")
    for number in range(8):
        sh = np.zeros((8, 1, 3))
        sh[:, 0] = np.where(np.arange(8) == number, 0.5, -0.5)[:, None] / SH_C0
        alone = ls.Scene([replace(one.gaussians(), sh=sh)])
        expected[number] = max(float(renderer.render(alone, view.camera).color.max()) for view in given)
    np.testing.assert_allclose(found, expected, atol=2e-6)
    assert found[4] == 0.0 and found.max() > 0.3


def test_training_prunes_and_counts_gaussians_of_small_blending_weight(tmp_path: Path) -> None:
    """Pruned Gaussians are removed from the capture, not from the checkpoint; the other Gaussians are unchanged."""
    folder = write_training_folder(tmp_path / "set")
    config = ls.TrainConfig(iterations=150, cap=150, initial=100, sh_degree=1)
    whole = ls.train(folder, config, output=tmp_path / "a.ply", device="cpu")
    some = ls.train(folder, replace(config, prune_below=0.02), output=tmp_path / "b.ply", device="cpu")
    assert whole.pruned == 0 and 0 < some.pruned < whole.gaussians.count / 2
    assert some.gaussians.count == whole.gaussians.count - some.pruned
    rows = {tuple(mean) for mean in whole.gaussians.means}
    assert all(tuple(mean) in rows for mean in some.gaussians.means)
    assert whole.score is not None and some.score is not None
    assert some.score.psnr == pytest.approx(whole.score.psnr, abs=0.1)
    with np.load(tmp_path / "b.training" / "checkpoint.npz") as state:
        assert len(state["values.means"]) == whole.gaussians.count
    assert ls.load(tmp_path / "b.ply").count == some.gaussians.count  # pyright: ignore[reportAttributeAccessIssue]


def test_training_prunes_nothing_if_all_blending_weights_are_too_small(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A log line reports it; the same training may be called again with another threshold."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    config = ls.TrainConfig(iterations=5, cap=100, initial=100, sh_degree=1, prune_below=0.9999)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        result = ls.train(folder, config, output=output, device="cpu")
    assert result.pruned == 0 and result.gaussians.count == 100 and output.exists()
    (line,) = [record.getMessage() for record in caplog.records if "prune_below" in record.getMessage()]
    assert line.startswith("TrainConfig.prune_below is 0.9999, but the largest blending weight of any Gaussian is 0.")
    assert line.endswith(": no Gaussian is pruned")
    fewer = ls.train(folder, replace(config, prune_below=0.1), output=output, device="cpu")
    assert fewer.pruned > 0 and fewer.gaussians.count == 100 - fewer.pruned
