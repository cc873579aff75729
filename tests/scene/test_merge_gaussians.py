"""Merging concatenates Gaussian sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.gaussians import merge_gaussians


def make(count: int, coefficients: int, *, albedo: bool = True) -> ls.Gaussians:
    """Returns Gaussians whose SH coefficients are all 1."""
    return ls.Gaussians(
        np.full((count, 3), count, dtype=np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.ones((count, 3), dtype=np.float32),
        np.full(count, 0.5, dtype=np.float32),
        np.ones((count, coefficients, 3), dtype=np.float32),
        albedo=np.full((count, 3), 0.25, dtype=np.float32) if albedo else None,
    )


def test_merged_captures_keep_their_order_and_pad_sh_with_zeros() -> None:
    """The Gaussians of each set follow those of the previous one, and lower SH degrees are padded."""
    both = merge_gaussians([make(2, 1), make(3, 4)])
    np.testing.assert_array_equal(both.means[:, 0], [2, 2, 3, 3, 3])
    np.testing.assert_array_equal(both.sh[:, 1:].any(axis=(1, 2)), [False, False, True, True, True])
    assert both.albedo is not None


def test_merge_drops_optional_arrays_that_some_captures_lack() -> None:
    """An optional array is kept only if all sets have it."""
    assert merge_gaussians([make(2, 1), make(3, 1, albedo=False)]).albedo is None


def test_merged_capture_has_the_settings_that_all_merged_captures_share() -> None:
    """Settings that all sets share are those of the merged set and of its subsets."""
    both = merge_gaussians([replace(make(2, 1), kernel_degree=4, antialiased=True)] * 2)
    assert (both.kernel_degree, both.antialiased) == (4, True)
    assert both.subset(np.array([0, 3])).kernel_degree == 4


def test_merge_refuses_empty_lists_and_captures_of_different_kernels() -> None:
    """Sets whose opacities or scales have different meanings cannot be merged."""
    with pytest.raises(ls.SceneError, match="expected at least one"):
        merge_gaussians([])
    with pytest.raises(ls.SceneError, match="antialiased"):
        merge_gaussians([make(1, 1), replace(make(1, 1), antialiased=True)])
    with pytest.raises(ls.SceneError, match="kernel degrees 0, 2"):
        merge_gaussians([make(1, 1), replace(make(1, 1), kernel_degree=0)])


def test_opaque_captures_can_be_merged_with_captures_of_another_antialiased_flag(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Opacity 1 means the same with and without dilation; lower opacities of trained captures do not."""
    opaque = replace(make(2, 1), opacities=np.full(2, 0.995, np.float32), antialiased=True)
    both = merge_gaussians([make(3, 1), opaque])
    assert both.count == 5 and not both.antialiased and "they are now dilated" in caplog.text
    assert merge_gaussians([opaque, opaque]).antialiased
    with pytest.raises(ls.SceneError, match="their opacities are defined differently"):
        merge_gaussians([make(3, 1), replace(make(2, 1), antialiased=True)])
