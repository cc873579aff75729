"""Metals and the environment that they reflect are found from captured colours and images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.color import encode_srgb
from lumisplat.math.directions import panorama_directions
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.metrics.materials import environment_psnr
from lumisplat.training import color_fit
from lumisplat.training.lit_gaussians import IncidentRadiance, Materials
from support.oracles.lit_gaussian_oracle import Lit, radiance
from support.scenes.lit_sphere import ball, write_training_images

GOLD, STEEL = np.array([0.9, 0.65, 0.3]), np.array([0.55, 0.55, 0.5])
ROUGHNESS, COUNT = 0.5, 150


def sky(directions: np.ndarray) -> np.ndarray:
    """Returns the radiance of a blue sky with a warm side for N directions, shape (N, 3)."""
    up, side = -directions[:, 1:2], directions[:, :1]
    warm = np.maximum(side, 0.0) ** 4
    return 0.15 + (0.5 + 0.5 * up) * (0.25, 0.35, 0.5) + warm * (0.9, 0.6, 0.2)


def metal_ball() -> tuple[ls.Gaussians, np.ndarray]:
    """Returns a ball, one half gold and the other steel, with the SH of its radiance in float64, and its albedo."""
    plain, directions = ball(COUNT), even_directions(256)
    normals = plain.means / np.linalg.norm(plain.means, axis=1, keepdims=True)
    albedo = np.where(plain.means[:, 2:] > 0.0, GOLD, STEEL)
    lit = Lit(
        means=plain.means.astype(np.float64),
        normals=normals,
        albedo=albedo,
        roughness=np.full(COUNT, ROUGHNESS),
        metallic=1.0,
        directions=directions,
        environment=sky(directions),
        open=np.ones((COUNT, 256)),
        seen=np.zeros((COUNT, 256, 3)),
        spread=0.09 * 4.0 * np.pi / 256,
    )
    eyes = 50.0 * even_directions(48)
    shown = encode_srgb(np.clip([radiance(lit, eye) for eye in eyes], 0.0, 1.0)) - 0.5
    basis = sh_basis(-eyes / 50.0, 3)
    sh = np.empty((COUNT, 16, 3))
    for i in range(COUNT):
        front = eyes @ normals[i] > 2.0
        system = basis[front].T @ basis[front] + 1e-3 * np.eye(16)
        sh[i] = np.linalg.solve(system, basis[front].T @ shown[front, i])
    return ls.Gaussians(plain.means, plain.rotations_wxyz, plain.scales, plain.opacities, sh), albedo


@pytest.fixture(scope="module")
def made() -> tuple[ls.Gaussians, np.ndarray]:
    """Returns the metal ball and its albedo."""
    return metal_ball()


def test_metals_and_their_environment_are_found_from_images(
    made: tuple[ls.Gaussians, np.ndarray], tmp_path: Path
) -> None:
    """Taken for dielectrics, the same images give an environment that is worse by several dB."""
    capture, albedo = made
    folder = write_training_images(tmp_path, capture, count=12)
    truth = sky(panorama_directions(16, 32).reshape(-1, 3)).reshape(16, 32, 3)
    metals, others = (
        ls.inverse.find_materials(
            capture, folder, ls.config.MaterialsConfig(directions=128, iterations=30, metal=metal), device="cpu"
        )
        for metal in (True, False)
    )
    assert metals.environment.image is not None and others.environment.image is not None
    assert environment_psnr(metals.environment.image, truth) > 35.0
    assert environment_psnr(others.environment.image, truth) < 31.0
    assert metals.gaussians.albedo is not None and metals.gaussians.metallic is not None
    mean = metals.environment.image.mean(axis=(0, 1))
    assert np.ptp(np.log(mean)) < 0.1  # grey by convention, as the true one nearly is
    expected = albedo * truth.mean(axis=(0, 1)) / mean
    assert np.abs(np.log(metals.gaussians.albedo / expected)).mean() < 0.1
    assert (metals.gaussians.metallic == 1.0).all() and others.gaussians.metallic is None


def test_gaussians_that_no_view_shows_take_the_albedo_of_their_neighbours(
    made: tuple[ls.Gaussians, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One hemisphere, half gold and half steel, is in no view; its captured colours, all light grey, do not count."""
    monkeypatch.setattr(color_fit, "STEPS", 200)
    capture, albedo = made
    hidden = capture.means[:, 0] > 0.1
    sh = np.where(hidden[:, None, None], 0.0, capture.sh).astype(np.float32)
    sh[hidden, 0] = 0.4 / SH_C0
    capture = ls.Gaussians(capture.means, capture.rotations_wxyz, capture.scales, capture.opacities, sh)
    directions, eyes = even_directions(32), 5.0 * even_directions(8)
    light = np.ones((COUNT, 32), np.float32), np.zeros((COUNT, 32, 3), np.float32)
    normals = capture.means / np.linalg.norm(capture.means, axis=1, keepdims=True)
    start = Materials(np.full((COUNT, 3), 0.6), np.full(COUNT, 0.5), normals.astype(np.float64), sky(directions))
    weights = np.maximum(eyes @ normals.T, 0.0) * ~hidden
    found = color_fit.fit_colors(
        capture,
        IncidentRadiance(directions, *light),
        start,
        color_fit.CapturedColors(list(eyes), weights.astype(np.float32)),
        seed=0,
        device="cpu",
        threads=1,
        report=lambda label, fraction: None,
    )
    is_gold = np.isclose(albedo, GOLD).all(axis=1)
    hue = found.albedo[:, 0] / found.albedo[:, 2]
    for rows in (hidden, ~hidden):
        assert hue[rows & is_gold].mean() > 1.3 * hue[rows & ~is_gold].mean()


@pytest.mark.parametrize(("count", "chosen"), [(1, [0]), (3, [0, 1, 2]), (47, list(range(0, 47, 2)))])
def test_views_whose_colours_are_fitted_are_evenly_spaced(count: int, chosen: list[int]) -> None:
    """There are at most 24."""
    assert color_fit.chosen_views(count) == chosen
