"""Materials and environment are found from images of a ball for which both are known."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.directions import panorama_directions
from lumisplat.math.sh import even_directions
from lumisplat.relighting.irradiance import Irradiance
from lumisplat.training.find_materials import MaterialFiles
from lumisplat.training.lit_gaussians import ray_starts, traced_incident
from lumisplat.training.material_fit import fit_environment, neighbour_pairs, white_radiance
from support.oracles.trace_oracle import trace_rays
from support.scenes.lit_sphere import ball, matte, write_training_images

QUICK = ls.config.MaterialsConfig(iterations=0)
GREY = np.array([0.5, 0.4, 0.3])


def silent(label: str, fraction: float) -> None:
    """Ignores progress."""


def constant_radiance(ray_directions: np.ndarray) -> np.ndarray:
    """Returns constant radiance for N ray directions, shape (N, 3)."""
    return np.full((len(ray_directions), 3), 0.8)


def bright_above(ray_directions: np.ndarray) -> np.ndarray:
    """Returns bluish radiance for N ray directions, brighter towards smaller y, shape (N, 3)."""
    return (1.0 - 0.8 * ray_directions[:, 1:2]) * (0.6, 0.7, 0.9)


def test_find_materials_recovers_a_constant_environment_and_albedo(tmp_path: Path) -> None:
    """Only the product of radiance and albedo is determined, for each channel."""
    capture = matte(ball(), GREY, constant_radiance)
    found = ls.inverse.find_materials(capture, write_training_images(tmp_path, capture), QUICK, device="cpu")
    albedo, image = found.gaussians.albedo, found.environment.image
    assert albedo is not None and image is not None
    assert np.ptp(albedo, axis=0).max() < 0.01
    np.testing.assert_allclose(image.std(axis=(0, 1)) / image.mean(axis=(0, 1)), 0.0, atol=0.01)
    np.testing.assert_allclose(albedo.mean(axis=0) * image.mean(axis=(0, 1)), 0.8 * GREY, rtol=0.01)
    assert found.too_light == 0.0 and np.isnan(found.error)


def test_find_materials_recovers_a_varying_environment_over_constant_albedo(tmp_path: Path) -> None:
    """Degree-1 SH of the environment relative to its mean is within 0.04, the albedo within 1 %."""
    capture = matte(ball(), GREY, bright_above)
    found = ls.inverse.find_materials(capture, write_training_images(tmp_path, capture), QUICK, device="cpu")
    albedo, image = found.gaussians.albedo, found.environment.image
    assert albedo is not None and image is not None
    assert (albedo / albedo.mean(axis=0)).std(axis=0).max() < 0.01
    ray_directions = panorama_directions(*image.shape[:2])
    weights = np.sin(np.arccos(np.clip(ray_directions[..., 1], -1.0, 1.0)))[..., None]
    mean = (weights * image).sum(axis=(0, 1)) / weights.sum()
    linear = 3.0 * (weights * image * ray_directions[..., 1:2]).sum(axis=(0, 1)) / weights.sum() / mean
    np.testing.assert_allclose(linear, -0.8, atol=0.04)


def test_find_materials_recovers_texture_from_the_images_that_the_capture_does_not_have(tmp_path: Path) -> None:
    """The images show a chequered ball, and the capture a ball of constant colour."""
    checks = np.where(np.sign(ball().means).prod(axis=1, keepdims=True) > 0.0, 1.0, 0.4) * GREY
    folder = write_training_images(tmp_path, matte(ball(), checks, constant_radiance))
    capture = matte(ball(), GREY, constant_radiance)
    errors = [
        ls.inverse.find_materials(
            capture, folder, ls.config.MaterialsConfig(directions=64, iterations=steps), device="cpu"
        )
        for steps in (1, 250)
    ]
    assert errors[1].error < 0.5 * errors[0].error
    albedo = errors[1].gaussians.albedo
    assert albedo is not None
    ratio = albedo[checks[:, 0] < 0.3].mean() / albedo[checks[:, 0] > 0.3].mean()
    assert ratio < 0.8


def test_find_materials_gives_the_same_bits_on_any_number_of_threads(tmp_path: Path) -> None:
    """Results of one and of three threads are compared."""
    capture = matte(ball(200), GREY, bright_above)
    folder, config = (
        write_training_images(tmp_path, capture),
        ls.config.MaterialsConfig(directions=32, environment_steps=20, iterations=4),
    )
    first, second = (
        ls.inverse.find_materials(capture, folder, config, device="cpu", threads=n).gaussians for n in (1, 3)
    )
    for name in ("albedo", "roughness", "normals"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_incident_light_and_visibility_traced_for_materials_match_brute_force() -> None:
    """The reference tests every Gaussian against every ray in float64, with the radiance of hits."""
    rng = np.random.default_rng(0)
    capture = ls.Gaussians(
        means=rng.uniform(-1.0, 1.0, (60, 3)),
        rotations_wxyz=rng.normal(size=(60, 4)),
        scales=rng.uniform(0.05, 0.3, (60, 3)),
        opacities=rng.uniform(0.3, 0.95, 60),
        sh=rng.normal(size=(60, 1, 3)),
    )
    normals = rng.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False), "cpu")
    directions = even_directions(8)
    found = traced_incident(capture, normals, directions, renderer, seed=3, report=silent)
    again = np.random.default_rng([3, 6])
    starts = ray_starts(capture, normals)
    for k, direction in enumerate(directions):
        ray_directions = direction + np.sqrt(np.pi / 8) * again.uniform(-1.0, 1.0, (60, 3))
        ray_directions /= np.linalg.norm(ray_directions, axis=1, keepdims=True)
        rows = np.flatnonzero(normals @ direction > 0.0)
        expected = trace_rays(ls.Scene([capture]), starts[rows], ray_directions[rows])
        np.testing.assert_allclose(found.open[rows, k], expected["transmittance"], atol=1e-3)
        alpha = 1.0 - expected["transmittance"][:, None]
        shown = decode_srgb(np.clip(expected["radiance"] / np.maximum(alpha, 1e-6), 0.0, 1.0))
        np.testing.assert_allclose(found.seen[rows, k], alpha * shown, atol=5e-3)
        below = np.setdiff1d(np.arange(60), rows)
        assert not found.open[below, k].any() and not found.seen[below, k].any()
    assert 0.1 < (found.open > 0.5).mean() < 0.9 and found.seen.max() > 0.5


def test_environment_fitted_with_materials_stays_constant_in_a_closed_room() -> None:
    """No ray leaves the room, so the captured radiance is the only light."""
    white = Irradiance(np.full((40, 3), 0.3), np.zeros((40, 16), np.float32), np.zeros((40, 0), np.float32))
    directions = even_directions(16)
    rng = np.random.default_rng(0)
    environment = fit_environment(
        np.full((40, 3), 0.15), white, np.ones(40), directions, steps=3, rng=rng, report=silent
    )
    assert (environment == 1.0).all()
    np.testing.assert_allclose(0.15 / white_radiance(white, environment), 0.5)


def test_fitted_environment_is_grey_in_mean_and_gives_a_largest_albedo_of_0_8() -> None:
    """The mean log radiance is grey; by weight, 95 % of the Gaussians have an albedo of at most 0.8."""
    rng = np.random.default_rng(1)
    white = Irradiance(
        np.full((300, 3), 0.02), rng.random((300, 32), np.float32) / 32.0, np.zeros((300, 0), np.float32)
    )
    weights, true = rng.random(300), rng.uniform(0.5, 2.0, (32, 3)) * (2.0, 1.0, 0.5)
    outgoing = rng.uniform(0.2, 0.6, (300, 1)) * white_radiance(white, true)
    environment = fit_environment(outgoing, white, weights, even_directions(32), steps=20, rng=rng, report=silent)
    assert np.ptp(np.log(environment).mean(axis=0)) < 1e-6 and np.ptp(np.log(environment)) > 0.1
    lightest = (outgoing / white_radiance(white, environment)).max(axis=1)
    assert weights[lightest <= 0.8 + 1e-3].sum() == pytest.approx(0.95 * weights.sum(), rel=0.01)


def test_material_smoothness_compares_each_gaussian_with_its_6_nearest_neighbours() -> None:
    """The reference computes all distances; coincident Gaussians are neighbours of each other, never of themselves."""
    points = (np.random.default_rng(2).random((3000, 3)) * (1.0, 1.0, 0.01)).astype(np.float32)
    distances = np.linalg.norm(points[:, None].astype(float) - points, axis=2)
    np.fill_diagonal(distances, np.inf)
    pairs = neighbour_pairs(points)
    np.testing.assert_array_equal(pairs.first, np.repeat(np.arange(3000), 6))
    np.testing.assert_array_equal(pairs.second.reshape(3000, 6), np.argsort(distances, axis=1)[:, :6])
    copies = neighbour_pairs(np.zeros((20, 3), np.float32))
    assert len(copies.first) == 120 and (copies.first != copies.second).all()


def test_material_smoothness_of_a_capture_of_one_gaussian_is_0() -> None:
    """A set of one Gaussian has no pairs of neighbours."""
    pairs = neighbour_pairs(np.zeros((1, 3), np.float32))
    assert len(pairs.first) == 0
    for term, gradient in (pairs.square_term(np.ones(1)), pairs.albedo_term(np.ones((1, 3)))):
        assert term == 0.0 and not gradient.any()


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("directions", 8, "directions is 8, expected"),
        ("iterations", -1, "iterations is -1, expected"),
        ("roughness", 0.0, "roughness is 0.0, expected"),
        ("seed", 1.5, "seed is 1.5, expected"),
    ],
)
def test_error_for_an_invalid_setting_of_materials_config_names_the_setting(
    name: str, value: float, problem: str
) -> None:
    """The error names the setting and its value."""
    with pytest.raises(ls.ConfigError, match=problem):
        ls.config.MaterialsConfig(**cast(Any, {name: value}))


def test_find_materials_logs_how_much_the_exposure_of_the_images_varies(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Every third image is a stop darker, every third a stop brighter; images of one exposure are not reported."""
    capture = matte(ball(200), 0.5 * GREY, constant_radiance)
    folder = write_training_images(tmp_path, capture, count=9, size=32)
    quick = ls.config.MaterialsConfig(directions=32, environment_steps=1, iterations=0)
    ls.inverse.find_materials(capture, folder, quick, device="cpu")
    assert "exposure" not in caplog.text
    for number, path in enumerate(sorted(folder.rglob("*.png"))):
        pixels = np.asarray(Image.open(path), np.float64) / 255.0
        linear = decode_srgb(pixels[..., :3]) * 2.0 ** (number % 3 - 1)
        pixels[..., :3] = encode_srgb(np.clip(linear, 0.0, 1.0))
        Image.fromarray((255.0 * pixels + 0.5).astype(np.uint8)).save(path)
    ls.inverse.find_materials(capture, folder, quick, device="cpu")
    match = re.search(
        r"varies by ([\d.]+) stops \(standard deviation\) relative to the capture: varying exposure", caplog.text
    )
    assert match is not None
    assert float(match[1]) == pytest.approx(np.std([-1, -1, 0, 0, 0, 1, 1, 1]), abs=0.03)  # the first image is held out


def test_find_materials_refuses_impossible_requests_with_a_one_line_error(tmp_path: Path) -> None:
    """Formats without materials, inputs that are no capture, and images that do not show the capture are refused."""
    capture = matte(ball(100), GREY, constant_radiance)
    folder = write_training_images(tmp_path / "set", capture, count=3, size=16)
    with pytest.raises(ls.ConfigError, match=r"expected \.ply"):
        ls.inverse.find_materials(capture, folder, QUICK, output=tmp_path / "a.spz", device="cpu")
    with pytest.raises(
        ls.SceneError, match=r"find_materials takes Gaussians, got a str \(lumisplat.load reads files\)"
    ):
        ls.inverse.find_materials(cast(Any, "a.ply"), folder, QUICK, device="cpu")
    away = ls.transform(capture, translation=(0.0, 1000.0, 0.0))
    with pytest.raises(ls.SceneError, match="no image shows the capture"):
        ls.inverse.find_materials(away, folder, QUICK, device="cpu")


def test_material_search_has_the_same_fingerprint_as_in_version_0_1_0(tmp_path: Path) -> None:
    """The hash is that of version 0.1.0, whose settings had another name for ``environment_steps``."""
    line = np.arange(3.0)
    means, rotations = np.stack([line] * 3, axis=1), np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    capture = ls.Gaussians(means, rotations, np.full((3, 3), 0.1), np.full(3, 0.5), np.zeros((3, 1, 3)))
    files = MaterialFiles.of(tmp_path, capture, "images", ls.config.MaterialsConfig())
    assert files.fingerprint == "6ea1ea743b12e98b18e0610d1ba3aa0a72adbf8e5fdc4dbe513a05522d8301f4"
