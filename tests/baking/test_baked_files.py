"""Baked captures saved as PLY and SPZ and loaded again show the baked colours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.sh import even_directions, sh_basis
from support.kinds import for_splats
from support.scenes.path_scenes import ball

STEPS = np.array([2.0 / 0.15 / 2.0 / 255.0] + 15 * [2.0 / 256.0])
"""Quantisation steps of SPZ's coefficients: 8 bits within +-3.33, and within +-1 (`lumisplat.io.splats.spz`)."""
COLORS = ls.RenderConfig(pipeline=ls.Pipeline.RASTER)


@pytest.fixture(scope="module")
def baked() -> ls.Gaussians:
    """Bakes a glossy ball in the direct light of two coloured lights."""
    shiny = ls.MaterialPbr(base_color=(0.5, 0.5, 0.5), metallic=0.7, roughness=0.5)
    lights = [
        ls.LightPoint((2.0, 2.0, -2.0), color=(1.0, 0.5, 0.4), intensity=12.0),
        ls.LightPoint((-2.0, 1.0, 2.0), color=(0.3, 0.5, 1.0), intensity=12.0),
    ]
    instance = ls.SplatInstance(ls.gaussians_from_mesh(ball(1.0, shiny), 200), material=for_splats(shiny))
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=2)
    return ls.bake(ls.Scene([instance], lights=lights), config, device="cpu").splats[0].gaussians


def loaded(baked: ls.Gaussians, path: Path) -> ls.Gaussians:
    """Saves the capture and loads it again."""
    ls.save(path, baked)
    gaussians = ls.load(path)
    assert isinstance(gaussians, ls.Gaussians)
    return gaussians


def frames(gaussians: ls.Gaussians) -> np.ndarray:
    """Renders unlit frames from four sides, stacked vertically."""
    scene = ls.Scene([ls.SplatInstance(gaussians)])
    eyes = [(0.0, 0.3, -3.5), (3.2, 1.4, 0.7), (-1.8, -0.7, 3.1), (-3.1, 2.1, -1.4)]
    cameras = [ls.Camera.look_at(eye, (0, 0, 0), (0, 1, 0), width=64, height=64, fov_y=0.7) for eye in eyes]
    return np.concatenate([ls.render(scene, camera, COLORS, device="cpu").color for camera in cameras])


def test_ply_stores_baked_sh_to_the_bit(baked, tmp_path):
    """Frames differ by the float32 rounding of scales that are saved as logarithms."""
    again = loaded(baked, tmp_path / "baked.ply")
    np.testing.assert_array_equal(again.sh, baked.sh)
    assert np.abs(baked.sh[:, 1:]).max() > 0.05  # the bake depends on the view
    np.testing.assert_allclose(frames(again), frames(baked), atol=2e-5)


def test_spz_stores_baked_colours_within_its_quantisation(baked, tmp_path):
    """A colour is off by at most half a quantisation step of each coefficient, from every direction.

    Coefficients of sharp highlights beyond -1..1, the range of SPZ, are clipped, as saving reports.
    """
    again = loaded(baked, tmp_path / "baked.spz")
    basis = sh_basis(even_directions(200), 3)
    clipped = np.concatenate([baked.sh[:, :1], np.clip(baked.sh[:, 1:], -1.0, 127.0 / 128.0)], axis=1)
    assert (clipped != baked.sh).mean() < 1e-3
    colors, expected = (np.einsum("dk,nkc->ndc", basis, sh) for sh in (again.sh, clipped))
    bound = 0.5 * np.abs(basis) @ STEPS
    off = np.abs(colors - expected).max(axis=(0, 2))
    assert (off <= bound + 1e-6).all()
    assert off.max() > 0.5 * 0.5 * SH_C0 * STEPS[0]  # quantisation has an effect
    # Frames of the baked shapes have at most the same error, because they blend these colours.
    same_shapes = frames(replace(baked, sh=again.sh))
    assert np.abs(same_shapes - frames(replace(baked, sh=clipped))).max() <= bound.max() + 1e-6


def test_frames_of_a_bake_before_and_after_saving_as_spz_match_with_over_45_db_psnr(baked, tmp_path):
    """Positions, scales, rotations and opacities are quantised too (docs/guide/bake.md)."""
    assert ls.metrics.psnr(frames(loaded(baked, tmp_path / "baked.spz")), frames(baked)) > 45.0
