"""Exposures of images are optimised together with the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.device.structs.camera import PixelData
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.training.exposure_and_pose import ExposedFrame, Exposures
from lumisplat.training.losses import ImageLoss
from lumisplat.training.trainer import Trainer
from support.scenes.training_scenes import BACKGROUND, cameras, known_gaussians, known_parameters, views
from training.test_image_loss import ALPHA, ENTROPY, SIZE, SSIM, expected, images

WIDTH, HEIGHT = SIZE


def exposed(color: np.ndarray, alpha: np.ndarray, exposure: np.ndarray) -> np.ndarray:
    """Applies an exposure in float64."""
    behind = (1.0 - alpha)[..., None] * np.array(BACKGROUND)
    return (color - behind) @ exposure[:, :3].T + alpha[..., None] * exposure[:, 3] + behind


def test_training_gradients_for_exposures_colours_and_alphas_match_central_differences() -> None:
    """The reference is the whole loss in float64."""
    color, alpha = images(1).astype(np.float64), images(2, None).astype(np.float64)
    wanted = images(3), images(4, None), images(5, None)
    exposure = np.eye(3, 4) + 0.2 * np.random.default_rng(6).normal(size=(3, 4))
    exposure = exposure.astype(np.float32).astype(np.float64)
    launcher, buffers = Launcher("cpu", 2), Buffers("cpu")
    pixels = PixelData()
    pixels.color = buffers.upload("color", wp.vec3, color.astype(np.float32).reshape(-1, 3))
    pixels.alpha = buffers.upload("alpha", wp.float32, alpha.astype(np.float32).reshape(-1))
    loss = ImageLoss(launcher, buffers, ssim=SSIM, alpha=ALPHA, entropy=ENTROPY)
    frame = ExposedFrame(launcher, buffers)
    frame.begin(exposure, BACKGROUND)
    gradient = loss.differentiate(SIZE, frame.apply(pixels), loss.load(*wanted))
    gradient = frame.backward(pixels, gradient)
    found, by_exposure = loss.read(SIZE), frame.by_exposure()
    arrays = gradient.color, gradient.alpha
    by_color, by_alpha = (np.array(array.numpy()) for array in arrays)  # pyright: ignore[reportUnknownMemberType]

    def total(color: np.ndarray, alpha: np.ndarray, exposure: np.ndarray) -> float:
        return expected(exposed(color, alpha, exposure), alpha, wanted)

    assert found.total == pytest.approx(total(color, alpha, exposure), abs=1e-6)
    given = color, alpha, exposure
    for which, by, indices in (
        (0, by_color.reshape(color.shape), [(0, 0, 0), (16, 22, 2), (8, 11, 1)]),
        (1, by_alpha.reshape(alpha.shape), [(0, 0), (16, 22), (8, 11), (3, 5)]),
        (2, by_exposure, [(row, column) for row in range(3) for column in range(4)]),
    ):
        scale = float(np.abs(by).mean())
        for index in indices:
            moved = [[values.copy() for values in given] for _ in range(2)]
            moved[0][which][index] += 1e-6
            moved[1][which][index] -= 1e-6
            slope = (total(*moved[0]) - total(*moved[1])) / 2e-6
            assert by[index] == pytest.approx(slope, abs=1e-4 * scale), (which, index)


def test_mean_over_all_images_of_trained_exposures_stays_the_identity() -> None:
    """The colours of the capture therefore do not drift, however single exposures move."""
    exposures, rng = Exposures.neutral(5), np.random.default_rng(0)
    for _ in range(19):
        for number in rng.permutation(5):
            exposures.update(int(number), rng.normal(number - 2.0, 0.2, (3, 4)), 0.01)
    np.testing.assert_allclose(exposures.values.mean(axis=0), np.eye(3, 4), atol=1e-12)
    assert np.abs(exposures.values - np.eye(3, 4)).max() > 0.01


def neutral_psnr(of: Trainer) -> float:
    """Returns the PSNR on views between the training views, without exposure."""
    renderer = ls.create_renderer(ls.RenderConfig(background=BACKGROUND), "cpu")
    scores: list[float] = []
    for camera in cameras(40)[33:]:
        shown, wanted = (renderer.render(ls.Scene([g]), camera).color for g in (of.gaussians(), known_gaussians()))
        scores.append(ls.metrics.psnr(np.clip(shown, 0.0, 1.0), np.clip(wanted, 0.0, 1.0)))
    return float(np.mean(scores))


def gains_of(count: int) -> np.ndarray:
    """Returns random gains of 0.7 to 1.3 with mean 1, shape (count, 3)."""
    gains = np.random.default_rng(2).uniform(0.7, 1.3, (count, 3))
    return gains / gains.mean(axis=0)


def errors_of(of: Trainer, gains: np.ndarray) -> np.ndarray:
    """Returns the relative errors of the estimated gains."""
    assert of.exposures is not None
    return np.abs(np.diagonal(of.exposures.values, axis1=1, axis2=2) / gains - 1.0)


def test_training_recovers_exposure_gains_of_images_of_a_known_scene() -> None:
    """Starting from the true scene, colours become wrong without exposures and stay right with them."""
    gains, rates = gains_of(8), ls.config.LearningRates(exposures=5e-2, exposures_last=5e-3)
    config = ls.TrainConfig(iterations=450, cap=30, sh_degree=1, opacity_decay=0.0, scale_decay=0.0, rates=rates)
    psnr: dict[bool, float] = {}
    for exposures in (False, True):
        given = replace(config, exposures=exposures)
        one = Trainer(views(8, gains=gains), given, background=BACKGROUND, points=known_gaussians().means, device="cpu")
        one._upload(known_parameters())
        for _ in range(config.iterations):
            one.step()
        psnr[exposures] = neutral_psnr(one)
        if exposures:
            errors = errors_of(one, gains)
            assert errors.mean() < 0.02 and errors.max() < 0.05, errors
    assert psnr[True] > psnr[False] + 15.0, psnr


def shown_gains(of: Trainer, seen: Sequence[ls.Camera]) -> np.ndarray:
    """Returns the gains that best fit the effect of the exposures on the true scene, shape (count, 3).

    The scene's colours are correlated, so other entries of the colour matrix stand for a part of the gains.
    """
    assert of.exposures is not None
    renderer = ls.create_renderer(ls.RenderConfig(background=BACKGROUND), "cpu")
    found: list[np.ndarray] = []
    for camera, exposure in zip(seen, of.exposures.values, strict=True):
        frame = renderer.render(ls.Scene([known_gaussians()]), camera)
        alpha = frame.alpha[..., None].astype(np.float64)
        shown = frame.color - (1.0 - alpha) * np.array(BACKGROUND)
        made = shown @ exposure[:, :3].T + alpha * exposure[:, 3]
        counts = alpha[..., 0] > 0.5
        found.append((made * shown)[counts].sum(axis=0) / (shown * shown)[counts].sum(axis=0))
    return np.array(found)


def beyond_directions(errors: np.ndarray, seen: Sequence[ls.Camera]) -> np.ndarray:
    """Returns the residual of a linear fit to the errors by view direction, which degree-1 SH would explain as well."""
    directions = [camera.eye / np.linalg.norm(camera.eye) for camera in seen]
    basis = np.column_stack([np.ones(len(seen)), np.array(directions)])
    return errors - basis @ np.linalg.lstsq(basis, errors, rcond=None)[0]


@pytest.mark.deep
def test_training_recovers_exposure_gains_together_with_the_scene() -> None:
    """The scene starts unknown; errors that vary linearly with the view direction are ignored."""
    gains, rates = gains_of(32), ls.config.LearningRates(exposures=3e-2)
    config = ls.TrainConfig(iterations=6000, cap=400, initial=400, sh_degree=1, rates=rates)
    psnr: dict[bool, float] = {}
    for exposures in (False, True):
        given = replace(config, exposures=exposures)
        one = Trainer(views(32, 64, gains), given, background=BACKGROUND, device="cpu")
        for _ in range(config.iterations):
            one.step()
        psnr[exposures] = neutral_psnr(one)
        if exposures:
            assert errors_of(one, gains).mean() < 0.03
            off = shown_gains(one, cameras(32, 64)) / gains - 1.0
            left = np.abs(beyond_directions(off, cameras(32, 64)))
            assert np.abs(off).mean() < 0.015 and left.mean() < 0.0075 and left.max() < 0.025, (off, left)
    assert psnr[True] > psnr[False] + 6.0, psnr
