"""Merging Gaussian sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.gaussians import merged


def make(count: int, coefficients: int, *, albedo: bool = True) -> ls.Gaussians:
    """Some Gaussians whose SH holds ones."""
    return ls.Gaussians(
        np.full((count, 3), count, dtype=np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.ones((count, 3), dtype=np.float32),
        np.full(count, 0.5, dtype=np.float32),
        np.ones((count, coefficients, 3), dtype=np.float32),
        albedo=np.full((count, 3), 0.25, dtype=np.float32) if albedo else None,
    )


def test_merged_keeps_order_and_pads_sh() -> None:
    """Rows follow each other; lower degrees get zeros, which add nothing."""
    both = merged([make(2, 1), make(3, 4)])
    np.testing.assert_array_equal(both.means[:, 0], [2, 2, 3, 3, 3])
    np.testing.assert_array_equal(both.sh[:, 1:].any(axis=(1, 2)), [False, False, True, True, True])
    assert both.albedo is not None


def test_merged_drops_what_not_all_sets_have() -> None:
    """An optional array survives only where every set has it."""
    assert merged([make(2, 1), make(3, 1, albedo=False)]).albedo is None


def test_settings_are_kept() -> None:
    """What all sets share about how they are to be rendered, the union and its parts still say."""
    both = merged([replace(make(2, 1), kernel_degree=4, antialiased=True)] * 2)
    assert (both.kernel_degree, both.antialiased) == (4, True)
    assert both.subset(np.array([0, 3])).kernel_degree == 4


def test_merged_refuses_nothing_and_mixed_settings() -> None:
    """No sets, and sets whose opacities or scales mean different things, raise one clear error."""
    with pytest.raises(ls.SceneError, match="nothing to merge"):
        merged([])
    with pytest.raises(ls.SceneError, match="antialiased"):
        merged([make(1, 1), replace(make(1, 1), antialiased=True)])
    with pytest.raises(ls.SceneError, match="kernel degrees 0, 2"):
        merged([make(1, 1), replace(make(1, 1), kernel_degree=0)])
