"""Tests of random numbers: stored values, equal bits on all devices, uniformity and independence."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

from lumisplat.device.math import random
from lumisplat.runtime.launcher import Launcher
from support.oracles.random_oracle import BRANCH_LAST, LENS_ANGLE, LENS_RADIUS, absorbed, draws, mix, sample_keys
from support.probes import probe_kernels

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
PIXELS = np.arange(1 << 18, dtype=np.uint32)
LAST = 2**32 - 1
LIMIT = 5.0
"""Largest absolute z-score that passes.

Good generators exceed the limit once in 1.7 million comparisons, so all 500 pass with probability 0.9997. The seeds
are fixed, so the result never changes."""


# --- Statistics ---


def chi_square_z(counts: np.ndarray) -> float:
    """Returns the z-score of a chi-square test for equal counts (Wilson and Hilferty 1931)."""
    expected = counts.sum() / counts.size
    freedom = counts.size - 1
    variance = 2.0 / (9.0 * freedom)
    ratio = ((counts - expected) ** 2).sum() / expected / freedom
    return float((np.cbrt(ratio) - (1.0 - variance)) / math.sqrt(variance))


def pair_z(first: np.ndarray, second: np.ndarray) -> list[float]:
    """Returns z-scores of pairs of draws: two chi-square tests on 16 x 16 grids and the correlation.

    The grids use bits 1-4 and 9-12 of the draws.
    """
    cells = [
        ((first >> shift) & 15).astype(np.int64) * 16 + ((second >> shift) & 15)
        for shift in (np.uint32(28), np.uint32(20))
    ]
    x, y = (words.astype(np.float64) / 2.0**32 - 0.5 for words in (first, second))
    correlation = 12.0 * float(np.mean(x * y)) * math.sqrt(x.size)
    return [*(chi_square_z(np.bincount(cell, minlength=256)) for cell in cells), correlation]


# --- Values ---


@pytest.mark.parametrize(
    ("pixel", "sample", "seed", "sample_key"),
    [
        (0, 0, 0, 0x89ED2DF0),
        (1, 0, 0, 0x23F4A3E5),
        (0, 1, 0, 0xCD9AE90B),
        (0, 0, 1, 0xD32952A8),
        (230_399, 255, LAST, 0x1701EFB9),
        (2**31 - 1, 2**24 - 1, 12345, 0x8B5F3FF8),
    ],
)
def test_keys_of_random_samples_match_values_stored_in_the_test(
    pixel: int, sample: int, seed: int, sample_key: int
) -> None:
    """The stored keys were computed once with Python's integers; other keys would change every frame of a seed."""
    assert int(random.sample_key_of(pixel, sample, wp.uint32(seed))) == sample_key


@pytest.mark.parametrize(
    ("sample_key", "dimension", "value"),
    [
        (0, 0, 0),
        (0, 1, 10_361_252),
        (0x12345678, 152_745, 5_214_623),
        (LAST, LAST, 131_804),
        (0x89ED2DF0, LAST - 1, 1_094_224),
    ],
)
def test_random_numbers_match_values_stored_in_the_test(sample_key: int, dimension: int, value: int) -> None:
    """All draws are multiples of 2^-24."""
    assert random.draw(wp.uint32(sample_key), wp.uint32(dimension)) == value * 2.0**-24


def test_bit_mixing_of_random_numbers_matches_its_published_definition() -> None:
    """The test contains the published permutation, written with Python's integers."""
    for word in (1, 2, 0xDEADBEEF, LAST, 0x80000000):
        x = word
        x = ((x ^ x >> 16) * 0x21F0AAAD) % 2**32
        x = ((x ^ x >> 15) * 0xD35A2D97) % 2**32
        assert int(random.mix(wp.uint32(word))) == int(mix(np.uint32(word))) == x ^ x >> 15


@pytest.mark.parametrize("device", DEVICES)
def test_random_numbers_of_kernels_numpy_and_python_have_equal_bits(device: str) -> None:
    """The bits are equal for the largest counters, too."""
    rng = np.random.default_rng(1)
    count = 20_000
    pixels, samples = rng.integers(0, 2**31, count, dtype=np.int32), rng.integers(0, 2**24, count, dtype=np.int32)
    seeds, dimensions = (rng.integers(0, 2**32, count, dtype=np.uint32) for _ in range(2))
    pixels[:2], samples[:2], seeds[:2], dimensions[:2] = (0, 2**31 - 1), (0, 2**24 - 1), (0, LAST), (0, LAST)
    inputs = [wp.array(values, device=device) for values in (pixels, samples, seeds, dimensions)]
    outputs = [wp.zeros(count, dtype=dtype, device=device) for dtype in (wp.uint32, wp.uint32, float)]
    Launcher(device, threads=1).run(probe_kernels.probe_random, count, *inputs, *outputs)
    keys, branches, drawn = (array.numpy() for array in outputs)
    expected = sample_keys(pixels, samples, seeds)
    np.testing.assert_array_equal(keys, expected)
    np.testing.assert_array_equal(branches, absorbed(expected, BRANCH_LAST - 1))
    np.testing.assert_array_equal(drawn, draws(expected, dimensions))
    for i in range(50):
        sample_key = random.sample_key_of(int(pixels[i]), int(samples[i]), wp.uint32(int(seeds[i])))
        assert int(sample_key) == keys[i]
        assert int(random.branch_key(sample_key, 1)) == branches[i]
        assert random.draw(sample_key, wp.uint32(int(dimensions[i]))) == drawn[i]
        assert random.draw_mixed(sample_key, random.mix(wp.uint32(int(dimensions[i])))) == drawn[i]


def test_random_draw_from_the_largest_32_bit_word_is_below_1() -> None:
    """The largest word also gives a draw below 1, since float32 represents 24 bits exactly."""
    inverse = pow(0xD35A2D97, -1, 2**32), pow(0x21F0AAAD, -1, 2**32)
    word = LAST  # the inverse permutation, which finds the word that it maps to 0xFFFFFFFF
    word ^= word >> 15 ^ word >> 30
    word = word * inverse[0] % 2**32
    word ^= word >> 15 ^ word >> 30
    word = word * inverse[1] % 2**32
    word ^= word >> 16
    assert int(random.mix(wp.uint32(word))) == LAST
    sample_key = (word - int(random.mix(wp.uint32(9)))) % 2**32
    assert random.draw(wp.uint32(sample_key), wp.uint32(9)) == 1.0 - 2.0**-24


def test_random_dimensions_of_lens_and_path_branches_differ_from_those_of_gaussians() -> None:
    """Dimensions of lens and branches count down from the largest number; those of Gaussians count up by index."""
    taken = [int(value) for value in (random.LENS_RADIUS, random.LENS_ANGLE, random.BRANCH_LAST)]
    assert taken == [LENS_RADIUS, LENS_ANGLE, BRANCH_LAST] == [LAST, LAST - 1, LAST - 2]


# --- Statistics ---


@pytest.mark.parametrize("dimension", [0, 1, 7, 152_745, 2**31 - 1, LAST - 3, LAST - 1, LAST])
def test_random_draws_are_uniform_over_pixels_samples_and_seeds(dimension: int) -> None:
    """The first 12 bits of the draws, and the next 12, are uniform over pixels, over samples and over seeds."""
    for key in (sample_keys(PIXELS), sample_keys(77, PIXELS), sample_keys(77, 5, PIXELS)):
        words = absorbed(key, dimension)
        for bits in (words >> 20, (words >> 8) & 0xFFF):
            assert abs(chi_square_z(np.bincount(bits, minlength=4096))) < LIMIT


@pytest.mark.parametrize("key", [0, 1, 12345, LAST])
def test_random_dimensions_of_one_key_are_uniform_and_independent(key: int) -> None:
    """The draws of one ray for all Gaussians are uniform, and Gaussians of neighbouring index draw independently."""
    words = absorbed(np.uint32(key), PIXELS)
    assert abs(chi_square_z(np.bincount(words >> 20, minlength=4096))) < LIMIT
    assert np.abs(pair_z(words[:-1], words[1:])).max() < LIMIT
    assert np.abs(pair_z(words[::2], words[1::2])).max() < LIMIT


@pytest.mark.parametrize("step", [1, 2, 3, 16, 255, 4096, 65_537, 1 << 20, 1 << 24, 1 << 28, 1 << 29, 1 << 30, 1 << 31])
def test_random_draws_of_different_gaussians_are_independent(step: int) -> None:
    """The draws are independent for every difference of indices."""
    key = sample_keys(PIXELS)
    for index in (0, 1, 1000):
        assert np.abs(pair_z(absorbed(key, index), absorbed(key, (index + step) % 2**32))).max() < LIMIT


@pytest.mark.parametrize("offset", [1, 2, 16, 640, 1920, 65_536])
def test_random_draws_of_different_pixels_are_independent(offset: int) -> None:
    """Draws of neighbours within a row and between rows are independent, for Gaussians and for lens points."""
    key = sample_keys(PIXELS)
    for dimension in (0, 12345, LAST):
        words = absorbed(key, dimension)
        assert np.abs(pair_z(words[:-offset], words[offset:])).max() < LIMIT


@pytest.mark.parametrize("step", [1, 2, 3, 255, 256, 65_536, 1 << 23])
def test_random_draws_of_different_samples_and_seeds_are_independent(step: int) -> None:
    """A pixel's successive samples are independent, and so are equal samples of different seeds."""
    first = sample_keys(PIXELS, seed=3)
    for second in (sample_keys(PIXELS, step, 3), sample_keys(PIXELS, 0, 3 + step)):
        for dimension in (0, 12345, LAST):
            assert np.abs(pair_z(absorbed(first, dimension), absorbed(second, dimension))).max() < LIMIT


def test_random_numbers_of_lens_coordinates_and_of_successive_bounces_are_independent() -> None:
    """The two lens coordinates are independent, and so are a Gaussian's draws before and after a mirror or glass."""
    key = sample_keys(PIXELS)
    assert np.abs(pair_z(absorbed(key, LENS_RADIUS), absorbed(key, LENS_ANGLE))).max() < LIMIT
    reflected, refracted = absorbed(key, BRANCH_LAST), absorbed(key, BRANCH_LAST - 1)
    for index in (0, 1, 12345):
        words = [absorbed(sample_key, index) for sample_key in (key, reflected, refracted)]
        for i, j in ((0, 1), (0, 2), (1, 2)):
            assert np.abs(pair_z(words[i], words[j])).max() < LIMIT


def test_all_pixels_and_samples_have_distinct_random_keys() -> None:
    """The mixing function is one-to-one, so no two pixels of a sample and no two samples of a pixel share a key."""
    assert np.unique(sample_keys(PIXELS)).size == PIXELS.size
    assert np.unique(sample_keys(7, PIXELS)).size == PIXELS.size


def test_statistical_tests_of_random_numbers_reject_weak_generators() -> None:
    """The statistical tests reject an unmixed counter and the low bits of a multiplication."""
    key = sample_keys(PIXELS)
    with np.errstate(over="ignore"):
        first, second = mix(key + np.uint32(5)), mix(key + np.uint32(5) + np.uint32(1 << 29))
        assert np.abs(pair_z(first, second)).max() > 2.0 * LIMIT
        assert abs(chi_square_z(np.bincount((PIXELS * np.uint32(0x21F0AAAD)) >> 20, minlength=4096))) > LIMIT


def sobol_points(keys: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Returns the points of each key's Sobol sequence, shape (keys, samples, 2), float64."""
    every_key, every_sample = (grid.ravel() for grid in np.meshgrid(keys, samples, indexing="ij"))
    points = wp.zeros(every_key.size, dtype=wp.vec2, device="cpu")
    inputs = (
        wp.array(values.astype(dtype), device="cpu")
        for values, dtype in ((every_key, np.uint32), (every_sample, np.int32))
    )
    Launcher("cpu", threads=1).run(probe_kernels.probe_sobol, every_key.size, *inputs, points)
    return points.numpy().astype(float).reshape(len(keys), len(samples), 2)


def test_sobol_points_of_kernels_and_python_have_equal_bits() -> None:
    """The kernel gives the same bits as the function called from Python."""
    points = sobol_points(np.array([0, 5, LAST]), np.array([0, 3, 100]))
    for i, key in enumerate((0, 5, LAST)):
        for j, sample in enumerate((0, 3, 100)):
            assert tuple(points[i, j]) == tuple(random.sobol_2d(wp.uint32(key), sample))


@pytest.mark.parametrize("key", [0, 0x9E3779B9])
def test_sobol_points_are_stratified_in_elementary_intervals(key: int) -> None:
    """Each aligned run of 2^n points has one point in each of the 2^n elementary intervals of every shape."""
    (points,) = sobol_points(np.array([key]), np.arange(128))
    assert (points >= 0.0).all() and (points < 1.0).all()
    for first, count in ((0, 64), (64, 64), (96, 32), (40, 8)):
        run = points[first : first + count]
        for columns in (2**k for k in range(int(np.log2(count)) + 1)):
            cells = np.floor(run * (columns, count // columns)).astype(int)
            assert len({tuple(cell) for cell in cells}) == count, (first, count, columns)


def test_sobol_points_of_different_keys_are_independent() -> None:
    """Points of one sample number are uniform in x and y over many keys, and independent between successive keys."""
    count = 800
    points = sobol_points(np.arange(count), np.array([0, 3])).reshape(count, 4)
    assert np.abs(points.mean(axis=0) - 0.5).max() < 4.5 / np.sqrt(12 * count)
    related = np.corrcoef(points[1:].T, points[:-1].T)
    assert np.abs(related[:4, 4:]).max() < 4.5 / np.sqrt(count)
    assert max(abs(related[0, 1]), abs(related[2, 3])) < 4.5 / np.sqrt(count)


def test_reversed_bits_reverses_the_bits_of_a_32_bit_word() -> None:
    """Reversing twice restores the word."""
    for word in (0, 1, 0x80000000, 0x12345678, 0xDEADBEEF):
        turned = int(random.reversed_bits(wp.uint32(word)))
        assert f"{turned:032b}" == f"{word:032b}"[::-1]
        assert int(random.reversed_bits(wp.uint32(turned))) == word
