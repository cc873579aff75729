"""Training handles transparent and masked pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TargetPixels, TrainingView
from support.scenes.training_scenes import cameras, known_gaussians

BLACK = (0.0, 0.0, 0.0)


def dark(count: int, size: int = 40) -> list[TrainingView]:
    """Returns training views with alpha of black Gaussians over a black background."""
    gaussians = replace(known_gaussians(), sh=np.full((30, 1, 3), -5.0))
    renderer, found = ls.create_renderer(ls.RenderConfig(), "cpu"), list[TrainingView]()
    for number, camera in enumerate(cameras(count, size)):
        frame = renderer.render(ls.Scene([gaussians]), camera)
        picture = TargetPixels(np.zeros((size, size, 3), np.float32), None, frame.alpha.astype(np.float32))
        found.append(TrainingView(f"{number:02d}", camera, lambda picture=picture: picture))
    return found


def error_of_alpha(config: ls.TrainConfig) -> float:
    """Trains, and returns the mean alpha error of views between the training views."""
    one = Trainer(dark(8), config, device="cpu")
    for _ in range(config.iterations):
        one.step()
    renderer = ls.create_renderer(ls.RenderConfig(), "cpu")
    errors: list[float] = []
    for camera in cameras(14)[8:]:
        shown, wanted = (renderer.render(ls.Scene([g]), camera).alpha for g in (one.gaussians(), known_gaussians()))
        errors.append(float(np.abs(shown - wanted).mean()))
    return float(np.mean(errors))


def test_alpha_of_objects_coloured_like_the_background_is_learnt_by_alpha_loss_or_random_backgrounds() -> None:
    """Gaussians in the colour of the background leave no trace in the colour loss."""
    config = ls.TrainConfig(iterations=300, cap=100, initial=100, sh_degree=0, alpha=0.0)
    nothing = error_of_alpha(config)
    assert error_of_alpha(replace(config, alpha=1.0)) < 0.4 * nothing
    assert error_of_alpha(replace(config, random_background=True)) < 0.5 * nothing


def test_random_training_backgrounds_depend_on_seed_and_iteration() -> None:
    """Frame and image of an iteration have one random background; images without alpha keep the original background."""
    config = ls.TrainConfig(iterations=50, cap=50, initial=50, sh_degree=0, random_background=True)
    behind = (0.2, 0.4, 0.6)
    clear, solid = dark(1)[0], dark(1)[0]
    alpha = clear.read().alpha
    assert alpha is not None
    over = ((1.0 - alpha)[..., None] * np.array(behind)).astype(np.float32)
    clear = replace(clear, read=lambda: TargetPixels(over, None, alpha), background=behind)
    solid = replace(solid, read=lambda: TargetPixels(over), background=behind)
    one, two = (Trainer([clear], config, background=behind, device="cpu") for _ in range(2))
    seen: list[tuple[TargetPixels, tuple[float, float, float]]] = []
    for one.iteration in range(5):
        seen.append(one._image_of(0))
    image, background = Trainer([solid], config, background=behind, device="cpu")._image_of(0)
    assert background == behind and (image.color == over).all()
    two.iteration = one.iteration
    assert two._image_of(0)[1] == seen[-1][1]
    assert len({background for _, background in seen}) == 5
    for image, background in seen:
        np.testing.assert_allclose(image.color, (1.0 - alpha)[..., None] * np.array(background), atol=1e-6)
    assert Trainer([clear], replace(config, seed=1), device="cpu")._image_of(0)[1] != two._image_of(0)[1]


def test_downscaled_training_images_exclude_colours_of_masked_pixels() -> None:
    """Colour and alpha of a downscaled pixel are means over the unmasked pixels of its area."""
    rng = np.random.default_rng(0)
    color, alpha = rng.uniform(size=(8, 6, 3)).astype(np.float32), rng.uniform(size=(8, 6)).astype(np.float32)
    weight = rng.integers(0, 2, (8, 6)).astype(np.float32)
    weight[:2, :2] = 0.0
    found = TargetPixels(color, weight, alpha).resized((3, 4))
    painted = TargetPixels(np.where(weight[..., None] > 0.0, color, 77.0).astype(np.float32), weight, alpha).resized(
        (3, 4)
    )
    np.testing.assert_array_equal(found.color, painted.color)
    assert found.weight is not None and found.alpha is not None
    for y, x in np.ndindex(4, 3):
        area = np.s_[2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
        assert found.weight[y, x] == pytest.approx(weight[area].mean())
        if weight[area].any():
            np.testing.assert_allclose(
                found.color[y, x], np.average(color[area].reshape(4, 3), 0, weight[area].ravel()), rtol=1e-5
            )
            assert found.alpha[y, x] == pytest.approx(float(np.average(alpha[area], weights=weight[area])), rel=1e-5)
    plain = TargetPixels(color).resized((3, 4))
    np.testing.assert_allclose(plain.color[0, 0], color[:2, :2].mean(axis=(0, 1)), rtol=1e-5)
    assert plain.weight is None and plain.alpha is None
