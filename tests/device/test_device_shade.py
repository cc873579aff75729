"""Tests of the stratified draws of stochastic samples and of the rule that assigns an edge to one triangle."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import warp as wp

from support.probes import probe_shade_kernels as probes

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
LIMIT = 5.0
"""Largest absolute z-score that passes; the seeds are fixed, so the result never changes."""


def numbers(device: str, dimensions: int, samples: int, seed: int = 0) -> np.ndarray:
    """Returns the draws, shape (dimensions, samples)."""
    out = wp.zeros((dimensions, samples), dtype=float, device=device)
    wp.launch(probes.draw_all, (dimensions, samples), [wp.uint32(seed), samples, out], device=device)
    return out.numpy().astype(float)


def z_of_counts(values: np.ndarray, bins: int) -> float:
    """Returns the z-score of a chi-square test for equal counts (Wilson and Hilferty 1931)."""
    counts = np.bincount(values.ravel(), minlength=bins)
    chi2 = ((counts - values.size / bins) ** 2).sum() * bins / values.size
    variance = 2.0 / (9.0 * (bins - 1))
    return float((np.cbrt(chi2 / (bins - 1)) - (1.0 - variance)) / math.sqrt(variance))


@pytest.mark.parametrize("device", DEVICES)
def test_each_16_stochastic_samples_draw_one_number_in_each_sixteenth_of_0_to_1(device: str) -> None:
    """Each aligned run of 16 samples has one draw per stratum in every dimension; draws are multiples of 2^-24."""
    drawn = numbers(device, 500, 64)
    assert (drawn >= 0.0).all() and (drawn < 1.0).all()
    np.testing.assert_array_equal(drawn * 2.0**24 % 1.0, 0.0)
    strata = (16.0 * drawn).astype(int).reshape(500, 4, 16)
    np.testing.assert_array_equal(np.sort(strata, axis=-1), np.broadcast_to(np.arange(16), strata.shape))
    assert (strata[:, 0] != strata[:, 1]).any(axis=-1).mean() > 0.99  # each run of 16 has its own order


@pytest.mark.parametrize("device", DEVICES)
def test_stratified_draws_of_stochastic_samples_are_uniform_and_independent(device: str) -> None:
    """Draws of one sample are uniform over Gaussians; draws of two Gaussians, samples or seeds are independent."""
    drawn = numbers(device, 1 << 16, 32)
    cells = (16.0 * drawn).astype(int)
    fine = (4096.0 * drawn).astype(int) % 256
    for sample in range(32):
        assert abs(z_of_counts(cells[:, sample], 16)) < LIMIT
        assert abs(z_of_counts(fine[:, sample], 256)) < LIMIT
        neighbours = 16 * cells[::2, sample] + cells[1::2, sample]
        assert abs(z_of_counts(neighbours, 256)) < LIMIT
    for one, two in ((0, 16), (3, 19), (15, 16), (7, 24)):
        assert abs(z_of_counts(16 * cells[:, one] + cells[:, two], 256)) < LIMIT
    other = (16.0 * numbers(device, 1 << 16, 1, seed=1)[:, 0]).astype(int)
    assert abs(z_of_counts(16 * cells[:, 0] + other, 256)) < LIMIT


@pytest.mark.parametrize("device", DEVICES)
def test_stratified_random_numbers_of_different_gaussians_are_independent(device: str) -> None:
    """The number of samples where both Gaussians draw low numbers follows the hypergeometric distribution."""
    low = numbers(device, 1 << 15, 16) < 0.5
    both = (low[::2] & low[1::2]).sum(axis=1)
    # Two draws of 8 out of 16 share a hypergeometric number: mean 4, variance 16/15.
    assert abs(both.mean() - 4.0) < LIMIT * math.sqrt(16.0 / 15.0 / len(both))
    assert both.var() == pytest.approx(16.0 / 15.0, rel=0.05)


@pytest.mark.parametrize("device", DEVICES)
def test_ray_through_a_shared_triangle_edge_hits_exactly_one_triangle(device: str) -> None:
    """A ray through a shared corner or edge hits one triangle, from every side and for both windings."""
    rng = np.random.default_rng(1)
    angles = (np.arange(7) + rng.uniform(0.0, 0.5, 7)) * 2.0 * math.pi / 7.0
    rim = np.round(np.stack([4.0 * np.cos(angles), 4.0 * np.sin(angles), 0.0 * angles], axis=-1) * 8.0) / 8.0
    fan = [(np.zeros(3), rim[i], rim[(i + 1) % 7]) for i in range(7)]
    fan = [(a, c, b) if i % 3 == 0 else (b, c, a) if i % 3 == 1 else (a, b, c) for i, (a, b, c) in enumerate(fan)]
    targets = np.concatenate([np.zeros((1, 3)), 0.5 * rim])
    for axis, sign in itertools.product(range(3), (-1.0, 1.0)):
        rotated = np.roll(np.array(fan), axis, axis=-1)
        along = np.roll([0.0, 0.0, sign], axis)
        origins = np.roll(targets, axis, axis=-1) - 5.0 * along
        owned = wp.zeros((len(targets), 7), dtype=int, device=device)
        arrays = [
            wp.array(rows.astype(np.float32), dtype=wp.vec3, device=device)
            for rows in (origins, np.broadcast_to(along, origins.shape).copy(), rotated)
        ]
        wp.launch(probes.own_all, (len(targets), 7), [*arrays, owned], device=device)
        owners = owned.numpy()
        assert owners[0].sum() == 1
        for i in range(7):
            assert owners[1 + i, [i - 1, i]].sum() == 1
