"""Materials and sky from photographs of a ball of which both are known."""

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
from lumisplat.training.lit_gaussians import ray_starts, traced_incident
from lumisplat.training.material_fit import fit_environment, neighbour_pairs, white_radiance
from support.oracles.trace_oracle import trace_rays
from support.scenes.lit_sphere import ball, matte, photographed

QUICK = ls.config.MaterialsConfig(iterations=0)
GREY = np.array([0.5, 0.4, 0.3])


def silent(label: str, fraction: float) -> None:
    """Progress that nobody looks at."""


def even(ways: np.ndarray) -> np.ndarray:
    """The same radiance from everywhere."""
    return np.full((len(ways), 3), 0.8)


def bright_above(ways: np.ndarray) -> np.ndarray:
    """Bluish, and brighter where y is less."""
    return (1.0 - 0.8 * ways[:, 1:2]) * (0.6, 0.7, 0.9)


def test_an_even_sky_and_albedo_are_found_exactly(tmp_path: Path) -> None:
    """But for what no photograph tells apart: light and albedo have the right product, channel by channel."""
    capture = matte(ball(), GREY, even)
    found = ls.inverse.find_materials(capture, photographed(tmp_path, capture), QUICK, device="cpu")
    albedo, image = found.gaussians.albedo, found.environment.image
    assert albedo is not None and image is not None
    assert np.ptp(albedo, axis=0).max() < 0.01
    np.testing.assert_allclose(image.std(axis=(0, 1)) / image.mean(axis=(0, 1)), 0.0, atol=0.01)
    np.testing.assert_allclose(albedo.mean(axis=0) * image.mean(axis=(0, 1)), 0.8 * GREY, rtol=0.01)
    assert found.too_light == 0.0 and np.isnan(found.error)


def test_a_sky_is_found_by_what_it_does_to_one_albedo(tmp_path: Path) -> None:
    """Its harmonics of degree 1, as a share of the mean, and the albedo, to 1 %."""
    capture = matte(ball(), GREY, bright_above)
    found = ls.inverse.find_materials(capture, photographed(tmp_path, capture), QUICK, device="cpu")
    albedo, image = found.gaussians.albedo, found.environment.image
    assert albedo is not None and image is not None
    assert (albedo / albedo.mean(axis=0)).std(axis=0).max() < 0.01
    ways = panorama_directions(*image.shape[:2])
    weights = np.sin(np.arccos(np.clip(ways[..., 1], -1.0, 1.0)))[..., None]
    mean = (weights * image).sum(axis=(0, 1)) / weights.sum()
    linear = 3.0 * (weights * image * ways[..., 1:2]).sum(axis=(0, 1)) / weights.sum() / mean
    np.testing.assert_allclose(linear, -0.8, atol=0.04)


def test_materials_are_refined_by_photographs(tmp_path: Path) -> None:
    """From a capture without its checks, whose photographs have them."""
    checks = np.where(np.sign(ball().means).prod(axis=1, keepdims=True) > 0.0, 1.0, 0.4) * GREY
    folder = photographed(tmp_path, matte(ball(), checks, even))
    capture = matte(ball(), GREY, even)
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


def test_the_same_seed_gives_the_same_bits(tmp_path: Path) -> None:
    """On any number of threads."""
    capture = matte(ball(200), GREY, bright_above)
    folder, config = (
        photographed(tmp_path, capture),
        ls.config.MaterialsConfig(directions=32, sky_steps=20, iterations=4),
    )
    first, second = (
        ls.inverse.find_materials(capture, folder, config, device="cpu", threads=n).gaussians for n in (1, 3)
    )
    for name in ("albedo", "roughness", "normals"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_visibility_is_that_of_brute_force() -> None:
    """Every Gaussian against every ray, float64; and radiance of what is hit."""
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
        ways = direction + np.sqrt(np.pi / 8) * again.uniform(-1.0, 1.0, (60, 3))
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        rows = np.flatnonzero(normals @ direction > 0.0)
        expected = trace_rays(ls.Scene([capture]), starts[rows], ways[rows])
        np.testing.assert_allclose(found.open[rows, k], expected["transmittance"], atol=1e-3)
        alpha = 1.0 - expected["transmittance"][:, None]
        shown = decode_srgb(np.clip(expected["radiance"] / np.maximum(alpha, 1e-6), 0.0, 1.0))
        np.testing.assert_allclose(found.seen[rows, k], alpha * shown, atol=5e-3)
        below = np.setdiff1d(np.arange(60), rows)
        assert not found.open[below, k].any() and not found.seen[below, k].any()
    assert 0.1 < (found.open > 0.5).mean() < 0.9 and found.seen.max() > 0.5


def test_a_closed_room_has_no_sky() -> None:
    """Then the sky stays as it begins, and what is seen is the light."""
    white = Irradiance(np.full((40, 3), 0.3), np.zeros((40, 16), np.float32), np.zeros((40, 0), np.float32))
    directions = even_directions(16)
    rng = np.random.default_rng(0)
    sky = fit_environment(np.full((40, 3), 0.15), white, np.ones(40), directions, steps=3, rng=rng, report=silent)
    assert (sky == 1.0).all()
    np.testing.assert_allclose(0.15 / white_radiance(white, sky), 0.5)


def test_the_sky_has_the_brightness_and_tint_that_are_conventions() -> None:
    """Grey on the average of its logarithms; the lightest surfaces, by weight, reflect 0.8."""
    rng = np.random.default_rng(1)
    white = Irradiance(
        np.full((300, 3), 0.02), rng.random((300, 32), np.float32) / 32.0, np.zeros((300, 0), np.float32)
    )
    weights, true = rng.random(300), rng.uniform(0.5, 2.0, (32, 3)) * (2.0, 1.0, 0.5)
    outgoing = rng.uniform(0.2, 0.6, (300, 1)) * white_radiance(white, true)
    sky = fit_environment(outgoing, white, weights, even_directions(32), steps=20, rng=rng, report=silent)
    assert np.ptp(np.log(sky).mean(axis=0)) < 1e-6 and np.ptp(np.log(sky)) > 0.1
    lightest = (outgoing / white_radiance(white, sky)).max(axis=1)
    assert weights[lightest <= 0.8 + 1e-3].sum() == pytest.approx(0.95 * weights.sum(), rel=0.01)


def test_neighbours_are_the_nearest_others() -> None:
    """Against all distances; Gaussians at one place are neighbours of each other, never of themselves."""
    points = (np.random.default_rng(2).random((3000, 3)) * (1.0, 1.0, 0.01)).astype(np.float32)
    distances = np.linalg.norm(points[:, None].astype(float) - points, axis=2)
    np.fill_diagonal(distances, np.inf)
    pairs = neighbour_pairs(points)
    np.testing.assert_array_equal(pairs.first, np.repeat(np.arange(3000), 6))
    np.testing.assert_array_equal(pairs.second.reshape(3000, 6), np.argsort(distances, axis=1)[:, :6])
    copies = neighbour_pairs(np.zeros((20, 3), np.float32))
    assert len(copies.first) == 120 and (copies.first != copies.second).all()


def test_a_single_gaussian_has_no_neighbours() -> None:
    """Nothing holds on to it, and nothing fails."""
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
def test_bad_settings(name: str, value: float, problem: str) -> None:
    """Are named."""
    with pytest.raises(ls.ConfigError, match=problem):
        ls.config.MaterialsConfig(**cast(Any, {name: value}))


def test_photographs_of_changing_exposure_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Every third a stop darker, every third a stop brighter, beside the same photographs as they were."""
    capture = matte(ball(200), 0.5 * GREY, even)
    folder = photographed(tmp_path, capture, count=9, size=32)
    quick = ls.config.MaterialsConfig(directions=32, sky_steps=1, iterations=0)
    ls.inverse.find_materials(capture, folder, quick, device="cpu")
    assert "exposure" not in caplog.text
    for number, path in enumerate(sorted(folder.rglob("*.png"))):
        pixels = np.asarray(Image.open(path), np.float64) / 255.0
        linear = decode_srgb(pixels[..., :3]) * 2.0 ** (number % 3 - 1)
        pixels[..., :3] = encode_srgb(np.clip(linear, 0.0, 1.0))
        Image.fromarray((255.0 * pixels + 0.5).astype(np.uint8)).save(path)
    ls.inverse.find_materials(capture, folder, quick, device="cpu")
    told = re.search(r"varies by ([\d.]+) stops \(standard deviation\)", caplog.text)
    assert told is not None
    assert float(told[1]) == pytest.approx(np.std([-1, -1, 0, 0, 0, 1, 1, 1]), abs=0.03)  # the first one is held out


def test_what_cannot_be_done_is_said_in_one_line(tmp_path: Path) -> None:
    """Outputs without columns; what is no capture; photographs of something else."""
    capture = matte(ball(100), GREY, even)
    folder = photographed(tmp_path / "set", capture, count=3, size=16)
    with pytest.raises(ls.ConfigError, match=r"expected a \.ply"):
        ls.inverse.find_materials(capture, folder, QUICK, output=tmp_path / "a.spz", device="cpu")
    with pytest.raises(
        ls.SceneError, match=r"find_materials takes Gaussians, got a str \(lumisplat.load reads files\)"
    ):
        ls.inverse.find_materials(cast(Any, "a.ply"), folder, QUICK, device="cpu")
    away = ls.transform(capture, translation=(0.0, 1000.0, 0.0))
    with pytest.raises(ls.SceneError, match="no image shows the capture"):
        ls.inverse.find_materials(away, folder, QUICK, device="cpu")
