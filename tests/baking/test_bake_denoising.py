"""Denoising of baked radiance over rays: matrix products, noise that vanishes and edges that stay."""

from __future__ import annotations

import numpy as np

from lumisplat.baking.bake_denoising import RayWeights, denoised_by_rays

GAUSSIANS, RAYS = 30, 6000
WEIGHTS = np.array([0.5, 0.3, 0.2])


def neighbours(rng: np.random.Generator) -> RayWeights:
    """Returns weights of rays that each blend three adjacent Gaussians."""
    first = rng.integers(0, GAUSSIANS - 2, RAYS)
    return RayWeights(
        ray=np.repeat(np.arange(RAYS), 3),
        gaussian=(first[:, None] + np.arange(3)).ravel(),
        weight=np.tile(WEIGHTS, RAYS),
        rays=RAYS,
        gaussians=GAUSSIANS,
    )


def test_sparse_weights_of_gaussians_along_baked_rays_equal_a_dense_matrix():
    """For the weight matrix W, colours a of Gaussians and r of rays, blends are W a, and means W^T r over W^T 1."""
    rng = np.random.default_rng(0)
    weights = neighbours(rng)
    matrix = np.zeros((RAYS, GAUSSIANS))
    np.add.at(matrix, (weights.ray, weights.gaussian), weights.weight)
    of_gaussians, of_rays = rng.normal(size=(GAUSSIANS, 3)), rng.normal(size=(RAYS, 3))
    np.testing.assert_allclose(weights.blended(of_gaussians), matrix @ of_gaussians, atol=1e-12)
    expected = (matrix.T @ of_rays) / matrix.sum(axis=0)[:, None]
    np.testing.assert_allclose(weights.mean_of(of_rays), expected, atol=1e-12)


def base_of(weights: RayWeights, colors: np.ndarray) -> np.ndarray:
    """Returns the colours of the rays in a constant environment."""
    return weights.blended(colors) / weights.blended(np.ones((GAUSSIANS, 1)))


ALL = np.ones((2, RAYS, 1))
"""Hit fractions of rays all of whose samples hit something."""


def test_denoising_a_bake_removes_noise_and_keeps_coloured_patches_of_an_evenly_lit_wall():
    """Coloured patches of an evenly lit wall keep their colours, with a tenth of the noise."""
    rng = np.random.default_rng(1)
    weights, colors = neighbours(rng), rng.uniform(0.1, 0.9, (GAUSSIANS, 3))
    truth = 0.7 * weights.blended(colors)
    noise = truth * rng.exponential(1.0, (2, RAYS, 1)) - truth  # rare and bright, as in path tracing
    light = denoised_by_rays(truth + noise, ALL, base_of(weights, colors), weights, 1.0)
    assert np.abs(light - truth).mean() < 0.1 * np.abs(noise).mean()
    np.testing.assert_allclose(light.mean(axis=(0, 1)), truth.mean(axis=0), rtol=0.03)
    np.testing.assert_allclose(
        denoised_by_rays(np.stack([truth, truth]), ALL, base_of(weights, colors), weights, 1.0)[0], truth, rtol=1e-9
    )


def test_denoising_a_bake_preserves_brightness_of_surfaces_with_dark_albedo():
    """Dividing by `SHARED_COLOR_MIN` in place of a far smaller albedo would lose half of the light and more."""
    rng = np.random.default_rng(5)
    weights = neighbours(rng)
    for color in (0.004, (0.6, 0.01, 0.004)):
        colors = np.broadcast_to(np.array(color), (GAUSSIANS, 3))
        truth = 0.7 * weights.blended(colors)
        halves = truth * rng.exponential(1.0, (2, RAYS, 1))
        light = denoised_by_rays(halves, ALL, base_of(weights, colors), weights, 1.0)
        np.testing.assert_allclose(light.mean(axis=(0, 1)) / halves.mean(axis=(0, 1)), 1.0, rtol=0.01)
        assert np.abs(light - truth).mean() < 0.2 * np.abs(halves - truth).mean()


def test_denoising_a_bake_keeps_black_beside_white():
    """White stays as bright as without black: rays that are black in constant light carry no information on light."""
    rng = np.random.default_rng(6)
    weights = neighbours(rng)
    white = np.arange(GAUSSIANS)[:, None] % 6 < 3
    colors = np.where(white, 0.8, 0.0) * np.ones(3)
    base = base_of(weights, colors)
    truth = 0.7 * base
    light = denoised_by_rays(truth * rng.exponential(1.0, (2, RAYS, 1)), ALL, base, weights, 1.0)
    black, bright = base[:, 0] == 0.0, base[:, 0] > 0.75
    assert black.sum() > 100 and (light[:, black] == 0.0).all()
    np.testing.assert_allclose(light[:, bright].mean(), truth[bright].mean(), rtol=0.03)


def test_denoising_a_bake_changes_no_ray_of_gaussians_whose_rays_are_half_in_shadow():
    """Half of the rays of each Gaussian are in shadow, more than noise explains, so no ray is averaged with others."""
    rng = np.random.default_rng(2)
    weights, colors = neighbours(rng), np.full((GAUSSIANS, 3), 0.5)
    lit = rng.random((RAYS, 1)) < 0.5
    halves = np.where(lit, 0.4, 0.0) + rng.normal(0.0, 0.02, (2, RAYS, 3))
    np.testing.assert_allclose(
        denoised_by_rays(halves, ALL, base_of(weights, colors), weights, 2.0), halves, atol=1e-12
    )


def test_baked_brightness_is_unbiased_where_gaussians_cover_a_ray_partially():
    """Radiance at an outline is that of the samples that hit, without the noise of the hit count.

    Division by the expected number of hits would be wrong by half and more.
    """
    rng = np.random.default_rng(3)
    weights = neighbours(rng)
    weights = RayWeights(weights.ray, weights.gaussian, 0.5 * weights.weight, weights.rays, weights.gaussians)
    colors = np.full((GAUSSIANS, 3), 0.6)
    found = rng.binomial(4, 0.5, (2, RAYS, 1)) / 4.0
    light = denoised_by_rays(found * 0.6 * np.array([0.5, 1.0, 2.0]), found, base_of(weights, colors), weights, 2.0)
    np.testing.assert_allclose(light, np.broadcast_to(0.6 * np.array([0.5, 1.0, 2.0]), light.shape), rtol=1e-9)


def test_denoising_a_bake_removes_noise_where_gaussians_cover_rays_partially():
    """A half of the samples with a single path, which hits nothing, carries no information on the noise."""
    rng = np.random.default_rng(4)
    weights, colors = neighbours(rng), np.full((GAUSSIANS, 3), 0.6)
    found = (rng.random((2, RAYS, 1)) < 0.4).astype(np.float64)
    halves = found * 0.35 * rng.exponential(1.0, (2, RAYS, 1)) * np.ones(3)
    light = denoised_by_rays(halves, found, base_of(weights, colors), weights, 1.0)
    hits = found.sum(axis=0)
    alone = np.divide(halves.sum(axis=0), hits, where=hits > 0.0, out=np.full((RAYS, 3), 0.35))
    assert np.sqrt(np.square(light - 0.35).mean()) < 0.2 * np.sqrt(np.square(alone - 0.35).mean())


def test_bake_denoiser_returns_zero_for_rays_without_gaussians():
    """Nothing is divided by zero."""
    weights = RayWeights(np.array([0]), np.array([1]), np.array([1.0]), rays=2, gaussians=3)
    light = denoised_by_rays(np.full((2, 2, 3), 0.3), np.ones((2, 2, 1)), np.full((2, 3), 0.5), weights, 1.0)
    np.testing.assert_allclose(light[:, 0], 0.3)
    assert (light[:, 1] == 0.0).all()
