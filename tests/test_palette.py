"""Palettes: the kernel against float64, and the properties of k-means."""

from __future__ import annotations

import numpy as np
import pytest

from lumisplat import palette_kernels
from lumisplat.palette import _Entries, _lloyd, _Search, fit_palette, group_shares
from lumisplat.runtime.launcher import Launcher
from support.oracles import palette_oracle


def clusters(count: int, components: int, centers: int = 12, seed: int = 3) -> np.ndarray:
    """Returns float32 vectors around ``centers`` random points."""
    rng = np.random.default_rng(seed)
    centres = rng.normal(0.0, 1.0, (centers, components))
    return (centres[rng.integers(0, centers, count)] + rng.normal(0.0, 0.1, (count, components))).astype(np.float32)


def squared_error(values: np.ndarray, entries: np.ndarray, labels: np.ndarray) -> float:
    """Returns the squared error summed over all components."""
    return float(((values.astype(np.float64) - entries[labels]) ** 2).sum())


@pytest.mark.parametrize("components", [9, 24, 45])
@pytest.mark.parametrize("threads", [1, 3])
def test_nearest_palette_entries_of_a_group_match_a_float64_search(components: int, threads: int) -> None:
    """Each vector gets the nearest entry of its own group, even if another group has a nearer one."""
    values = clusters(500, components)
    group = np.random.default_rng(1).integers(0, 4, len(values))
    counts = np.array([1, 16, 17, 40])
    launcher = Launcher("cpu", threads=threads)
    launcher.load([palette_kernels])
    entries = _Entries(values, group, counts)
    labels, distances = _Search(launcher, values, group, entries.first_row).nearest(entries.values)
    for g, (row, count) in enumerate(zip(entries.first_row, counts, strict=False)):
        inside = group == g
        own = entries.values[16 * row : 16 * row + count]
        expected, squares = palette_oracle.nearest(values[inside], own)
        np.testing.assert_allclose(distances[inside], squares, rtol=1e-5, atol=1e-10)
        np.testing.assert_array_equal(labels[inside] - 16 * row, expected)


@pytest.mark.parametrize("count", [1, 5, 16, 40])
def test_palette_of_one_level_has_the_error_of_float64_k_means(count: int) -> None:
    """Within one group, k-means reaches the error of its float64 twin from the same start."""
    values = clusters(300, 9)
    launcher = Launcher("cpu")
    launcher.load([palette_kernels])
    palette, distances = _lloyd(launcher, values, np.zeros(300, dtype=np.int64), np.array([count]))
    expected = squared_error(values, *palette_oracle.one_level(values, count, 10))
    assert squared_error(values, palette.entries, palette.labels) == pytest.approx(expected, rel=1e-4)
    assert distances.sum() == pytest.approx(expected, rel=1e-4)


def test_palette_entry_without_vectors_moves_to_the_vector_of_largest_error() -> None:
    """An entry without vectors moves to the vector of its group that is farthest from its own entry."""
    values = np.array([[0.0], [1.0], [7.0], [2.0], [90.0]], np.float32)
    group = np.array([0, 0, 0, 0, 1])
    entries = _Entries(values, group, np.array([2, 1]))
    entries.move(np.array([0, 0, 0, 0, 16]), np.array([6.25, 2.25, 20.25, 0.25, 0.0], np.float32))
    np.testing.assert_array_equal(entries.values[[0, 1, 16], 0], [2.5, 7.0, 90.0])


def test_palette_of_two_levels_has_at_most_2_percent_more_error_than_of_one_level() -> None:
    """A two-level palette has at most the error of ten k-means steps that compare with all entries."""
    values = clusters(1200, 24, centers=50)
    palette = fit_palette(values, 256, "cpu")
    assert len(palette.entries) <= 256
    expected = squared_error(values, *palette_oracle.one_level(values, 256, 10))
    assert squared_error(values, palette.entries, palette.labels) < 1.02 * expected


def test_palette_of_few_distinct_vectors_is_exact() -> None:
    """Vectors repeat, but at most as many are distinct as the palette has entries."""
    values = np.repeat(clusters(37, 45), np.arange(1, 38), axis=0)
    palette = fit_palette(np.random.default_rng(0).permutation(values), 256, "cpu")
    assert len(palette.entries) == 37
    np.testing.assert_array_equal(np.sort(palette.entries[:, 0]), np.unique(values[:, 0]))


@pytest.mark.parametrize("count", [1, 2, 64])
def test_palette_of_identical_vectors_has_one_entry(count: int) -> None:
    """The palette is made of one vector, or of many identical vectors."""
    for values in (np.ones((1, 9), np.float32), np.ones((50, 9), np.float32)):
        palette = fit_palette(values, count, "cpu")
        np.testing.assert_array_equal(palette.entries, np.ones((1, 9)))
        np.testing.assert_array_equal(palette.labels, np.zeros(len(values)))


def test_palette_of_equal_vectors_is_identical_in_repeated_calls() -> None:
    """The palette depends neither on chance nor on the number of threads."""
    values = clusters(700, 24)
    first, second = (fit_palette(values, 64, "cpu") for _ in range(2))
    np.testing.assert_array_equal(first.entries, second.entries)
    np.testing.assert_array_equal(first.labels, second.labels)


def test_palette_entries_are_divided_among_groups_by_the_root_of_size_times_error() -> None:
    """Entries are divided by the root of size times error; no group is empty or has more entries than vectors."""
    group = np.repeat([0, 1, 2, 3], [100, 100, 400, 2])
    errors = np.repeat([1.0, 4.0, 1.0, 0.0], [100, 100, 400, 2]).astype(np.float32)
    np.testing.assert_array_equal(group_shares(group, errors, 70), [10, 20, 40, 1])
    np.testing.assert_array_equal(group_shares(group, errors, 700)[:3], [100, 100, 400])
