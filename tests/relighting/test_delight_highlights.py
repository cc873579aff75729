"""Roughness is estimated from highlights: tables equal the equations, and known roughness is recovered."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SPREAD_SHARE
from lumisplat.math.color import encode_srgb
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.relighting.albedo_fit import EnvironmentCells, Light
from lumisplat.relighting.incident import neighbours_of, normal_variances
from lumisplat.relighting.irradiance import Irradiance
from lumisplat.relighting.roughness_fit import (
    BIN_RINGS,
    BIN_SECTORS,
    ROUGHNESS_GRID,
    ROUGHNESS_UNKNOWN,
    Lobes,
    RoughnessFit,
    arriving_light,
    bin_samples,
    bins_of,
    frames_of,
    sh_projection,
    widened,
)
from lumisplat.scene.ops.neighbours import cross_pairs
from support.oracles import bsdf_oracle

Z = np.array([0.0, 0.0, 1.0])


def material(alpha: float) -> bsdf_oracle.Material:
    """Returns a white dielectric with index of refraction 1.5."""
    return {
        "model": "pbr", "alpha": alpha, "specular": [0.04], "grazing": 1.0, "dielectric": 1.0, "eta": 1.0 / 1.5,
        "diffuse": [1.0],
    }  # fmt: skip


@pytest.fixture(scope="module")
def lobes() -> Lobes:
    """Returns the tables for captures of SH degree 3."""
    return Lobes.of(3)


def test_tables_of_bsdf_lobes_for_delight_match_the_float64_equations(lobes: Lobes) -> None:
    """Entries of both lobes are cosine-weighted means over the directions of a bin, for each roughness."""
    samples = bin_samples()
    spread = SPREAD_SHARE**2 * 2.0 * np.pi / (samples.shape[0] * samples.shape[1])
    cosines = samples[..., 2]
    rows = np.arange(0, len(samples), 7)
    for number, roughness in enumerate(ROUGHNESS_GRID):
        view, light = lobes.views[::5, None, None], samples[None, rows]
        wide = float(np.sqrt(roughness**4 + spread))
        highlight = np.pi * bsdf_oracle.pbr_specular(material(wide), Z, view, light)[..., 0]
        matt = np.pi * bsdf_oracle.pbr_diffuse(material(roughness**2), Z, view, light)[..., 0]
        for table, values in ((lobes.highlight, highlight), (lobes.matt, matt)):
            expected = (values * cosines[rows]).sum(axis=-1) / cosines[rows].sum(axis=-1)
            assert np.allclose(table[number, ::5][:, rows], expected, rtol=2e-4, atol=2e-5)


def test_direction_sampled_in_a_bin_of_the_hemisphere_is_assigned_to_that_bin() -> None:
    """The frames are rotations that take z to the normals, and `bins_of` finds each sample in its bin."""
    normals = even_directions(50)
    frames = frames_of(normals)
    assert np.allclose(frames @ np.swapaxes(frames, 1, 2), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(frames), 1.0)
    assert np.allclose(frames @ Z, normals)
    samples = bin_samples()
    numbers = np.repeat(np.arange(len(samples)), samples.shape[1])
    assert np.array_equal(bins_of(samples.reshape(-1, 3)), numbers)


def test_sh_projection_of_views_keeps_low_degrees_and_removes_high_ones(lobes: Lobes) -> None:
    """Degree 1 is kept except for the shrinkage by the ridge, high degrees are removed, and degree 0 keeps the mean."""
    low = sh_basis(lobes.views, 1)[:, 1:]
    assert np.abs(sh_projection(lobes.views, 3) @ low - low).max() < 0.02
    high = np.cos(12.0 * np.arctan2(lobes.views[:, 1], lobes.views[:, 0]))
    assert np.square(sh_projection(lobes.views, 1) @ high).mean() < 0.1 * np.square(high).mean()
    assert np.allclose(sh_projection(lobes.views, 0), 1.0 / len(lobes.views))


def test_irradiance_from_each_environment_cell_is_in_the_bin_of_its_direction() -> None:
    """Irradiance from environment and capture is binned by direction, and the bins sum to the total."""
    normals = even_directions(9)
    cells = EnvironmentCells.even(4)
    rng = np.random.default_rng(2)
    cosines = np.maximum(normals @ cells.directions.T, 0.0)
    environment = (cosines * rng.random(cosines.shape)).astype(np.float32)
    by_direction = (cosines.T[..., None] * rng.random((16, 9, 3))).astype(np.float16)
    light = Light(rng.random((16, 3)), np.zeros((0, 3)))
    incident = Irradiance(
        by_direction.sum(axis=0), environment, np.zeros((9, 0), np.float32), cells.directions, by_direction
    )
    arriving = arriving_light(normals, cells, incident, light)
    assert arriving.shape == (9, BIN_RINGS * BIN_SECTORS, 3)
    assert np.allclose(arriving.sum(axis=1), incident.total(light.environment, light.emitters), atol=2e-3)
    local = np.einsum("nij,ki->nkj", frames_of(normals), cells.directions)
    mean = np.einsum("nqc,qk->nk", arriving, bin_samples().mean(axis=1))
    expected = np.einsum(
        "nkc,nkj->nj", environment[..., None] * light.environment + np.swapaxes(by_direction, 0, 1), local
    )
    assert np.abs(mean - expected).max() < 0.12 * np.abs(expected).max()


def glossy(
    roughness: float, degree: int, noise: float = 0.0, turns: float = 0.0
) -> tuple[ls.Gaussians, np.ndarray, np.ndarray]:
    """Returns Gaussians of one material lit by a bright patch, by float64 equations; their normals and binned light.

    The Gaussians lie on a ball whose normal turns by ``turns`` radians within one scale of a Gaussian; 0 puts them far
    apart, without curvature.
    """
    rng = np.random.default_rng(3)
    count = 30
    normals = even_directions(count)
    samples = bin_samples()
    middle = samples.mean(axis=1) / np.linalg.norm(samples.mean(axis=1), axis=1, keepdims=True)
    patch = middle @ (np.array((0.5, 0.1, 0.86)) / np.linalg.norm((0.5, 0.1, 0.86))) > 0.9
    radiance = np.where(patch, 4.0, 0.25)[:, None, None] * np.ones((1, samples.shape[1], 1))
    solid = 2.0 * np.pi / (samples.shape[0] * samples.shape[1])
    views = even_directions(120)
    views = views[views[:, 2] > 0.0]
    light = samples.reshape(-1, 3)
    sums, areas = np.zeros((len(views), 3)), np.zeros((len(views), 1))
    for weight, normal in turned_normals(turns):  # weights are the cosines to the view
        area = weight * np.maximum(views @ normal, 0.0)[:, None]
        sums += area * radiance_of(roughness, normal, views, light, radiance.ravel() * solid)
        areas += area
    shown = encode_srgb(np.clip(sums / areas, 0.0, 1.0))
    sh = np.empty((count, (degree + 1) ** 2, 3))
    for row, frame in enumerate(frames_of(normals)):
        noisy = shown - 0.5 + noise * rng.standard_normal(shown.shape)
        sh[row] = np.linalg.lstsq(sh_basis(-views @ frame.T, degree), noisy, rcond=None)[0]
    arriving = np.zeros((count, len(samples), 3), np.float32)
    flat = radiance.ravel() * light[:, 2] * solid / np.pi
    arriving[:] = flat.reshape(len(samples), -1).sum(axis=1)[None, :, None]
    scale = 0.01
    plain = ls.Gaussians(
        normals * (scale / turns if turns else 100.0),
        np.tile((1.0, 0.0, 0.0, 0.0), (count, 1)),
        np.full((count, 3), scale),
        np.ones(count),
        sh.astype(np.float32),
    )
    return plain, normals, arriving


def turned_normals(spread: float) -> list[tuple[float, np.ndarray]]:
    """Returns weights and normals around z whose slopes are normally distributed, by Gauss-Hermite quadrature."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(5 if spread else 1)
    weights = weights / weights.sum()
    pairs = [(i, j) for i in range(len(nodes)) for j in range(len(nodes)) if weights[i] * weights[j] > 1e-3]
    normals = [np.array((spread * nodes[i], spread * nodes[j], 1.0)) for i, j in pairs]
    shares = np.array([weights[i] * weights[j] for i, j in pairs])
    return [
        (float(share), normal / np.linalg.norm(normal))
        for share, normal in zip(shares / shares.sum(), normals, strict=True)
    ]


def radiance_of(
    roughness: float, normal: np.ndarray, views: np.ndarray, light: np.ndarray, power: np.ndarray
) -> np.ndarray:
    """Returns the linear radiance of a brown surface towards V view directions, (V, 3); 0 for directions below it."""
    arriving = power * np.maximum(light @ normal, 0.0)
    lit, seen = arriving > 0.0, views @ normal > 0.0
    wide = float(np.sqrt(roughness**4 + SPREAD_SHARE**2 * 2.0 * np.pi / len(light)))
    directions = views[seen][:, None], light[lit][None]
    highlight = bsdf_oracle.pbr_specular(material(wide), normal, *directions)[..., 0] @ arriving[lit]
    matt = bsdf_oracle.pbr_diffuse(material(roughness**2), normal, *directions)[..., 0] @ arriving[lit]
    shown = np.zeros((len(views), 3))
    shown[seen] = np.array((0.5, 0.3, 0.2)) * matt[:, None] + highlight[:, None]
    return shown


def fitted_roughness(plain: ls.Gaussians, normals: np.ndarray, arriving: np.ndarray, reach: float = 0.01) -> np.ndarray:
    """Fits roughness; ``reach`` is the distance to neighbours relative to the distance from the centre."""
    means = plain.means.astype(np.float64)
    near = cross_pairs(means, means, reach * float(np.linalg.norm(means[0])))
    return RoughnessFit(plain, normals, near, Lobes.of(plain.sh_degree)).fitted(arriving)


@pytest.mark.parametrize("roughness", [0.3, 0.5, 0.7])
def test_roughness_is_recovered_from_sh_highlights_to_0_05(roughness: float) -> None:
    """The SH have degree 3, arbitrary frames, and noise of 1 of 255."""
    rough = fitted_roughness(*glossy(roughness, 3, 1.0 / 255.0))
    assert np.abs(rough - roughness).max() < 0.05


@pytest.mark.parametrize(("roughness", "turns", "near", "flat"), [(0.5, 0.15, 0.03, 0.06), (0.6, 0.2, 0.1, 0.11)])
def test_roughness_fit_to_sh_highlights_allows_for_the_curvature_of_the_surface(
    roughness: float, turns: float, near: float, flat: float
) -> None:
    """Roughness on a ball is recovered; if the same colours are taken for a flat surface, the fit is rougher."""
    case = glossy(roughness, 3, 1.0 / 255.0, turns)
    assert np.abs(fitted_roughness(*case, 0.9) - roughness).max() < near
    assert np.median(fitted_roughness(*case)) > roughness + flat


def test_estimated_variance_of_normals_is_the_square_of_curvature_times_scale() -> None:
    """The law holds on a ball; on a plane, and for Gaussians without neighbours, the variance is 0."""
    ball = ls.gaussians_from_mesh(ls.sphere(2.0), 800)
    normals = np.asarray(ball.normals, np.float64)
    expected = np.square(ball.scales.max(axis=1) / 2.0)
    assert np.median(normal_variances(ball, normals, neighbours_of(ball)) / expected) == pytest.approx(1.0, abs=0.1)
    flat = ls.gaussians_from_mesh(ls.plane(1.0, 1.0), 200)
    both = np.repeat([[0.0, 1.0, 0.0]], flat.count, axis=0) * np.where(np.arange(flat.count) % 2, 1.0, -1.0)[:, None]
    assert normal_variances(flat, both, neighbours_of(flat)).max() < 1e-12
    alone = cross_pairs(ball.means, ball.means, 1e-3)
    assert normal_variances(ball, normals, alone).max() < 1e-12


def test_bsdf_lobes_on_a_curved_surface_are_widened_by_the_variance_of_its_normals() -> None:
    """Weights over the roughness grid sum to 1, variance 0 keeps the roughness, and variances of slopes add."""
    grid = np.array(ROUGHNESS_GRID)
    variances = np.array((0.0, 0.005, 0.05))
    shares = widened(variances)
    assert np.allclose(shares.sum(axis=2), 1.0)
    assert np.allclose(shares[0], np.eye(len(grid)))
    expected = np.minimum((grid**4 + 2.0 * variances[:, None]) ** 0.25, 1.0)
    assert np.allclose(shares @ grid, expected)


def test_roughness_tends_to_0_8_where_sh_cannot_show_highlights() -> None:
    """SH of degree 0 leave the prior to the bit; a very sharp highlight only gives an upper bound of the roughness."""
    unknown = fitted_roughness(*glossy(0.4, 0))
    assert (unknown == np.float32(ROUGHNESS_UNKNOWN)).all()
    assert fitted_roughness(*glossy(0.15, 3)).max() < 0.35
    assert fitted_roughness(*glossy(0.4, 1, 0.02)).mean() > fitted_roughness(*glossy(0.4, 3, 0.02)).mean()


def test_roughness_fit_does_not_mistake_noise_for_highlights() -> None:
    """Random view dependence does not give a small roughness."""
    plain, normals, arriving = glossy(1.0, 3)
    rng = np.random.default_rng(8)
    sh = plain.sh.copy()
    sh[:, 1:] += 0.1 * rng.standard_normal(sh[:, 1:].shape)
    noisy = ls.Gaussians(plain.means, plain.rotations_wxyz, plain.scales, plain.opacities, sh)
    rough = fitted_roughness(noisy, normals, arriving)
    assert np.median(rough) > 0.65
