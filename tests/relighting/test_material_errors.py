"""Intervals of found albedos: nine tenths of the truth lie within, and squares of independent errors add up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.relighting.incident import neighbours_of
from lumisplat.relighting.material_errors import DIM_MAX, AlbedoErrors

MATT = ls.MaterialPbr(specular=0.0, roughness=1.0)


def test_intervals_of_albedo_widen_with_dim_light_and_with_a_difference_from_neighbours() -> None:
    """Each source gives its half width alone, squares add up, and light above the median does not count."""
    flat = ls.gaussians_from_mesh(ls.plane(1.0, 1.0), 200)
    near, normals = neighbours_of(flat), np.asarray(flat.normals, np.float64)
    albedo, light = np.full((flat.count, 3), 0.5), np.ones(flat.count)
    light[:3] = (0.5, 1e-6, 4.0)
    assert AlbedoErrors(0.1, 2.0, 0.3).of(albedo, light, normals, near)[:4] == pytest.approx(
        np.hypot(0.1, 0.3 * np.array((1.0, DIM_MAX - 1.0, 0.0, 0.0))), rel=1e-6
    )
    albedo[10] *= np.exp(0.7)
    apart = AlbedoErrors(0.0, 2.0, 0.0).of(albedo, light, normals, near)
    share = 1.0 / np.count_nonzero(near.first == 10)
    assert apart[10] == pytest.approx(2.0 * 0.7 * (1.0 - share), rel=1e-4) and np.median(apart) < 1e-6


@pytest.fixture(scope="module")
def lit_ball() -> tuple[ls.Gaussians, ls.Gaussians]:
    """Returns a ball on a floor with true albedo, and as captured in sun and sky."""
    ball, floor = ls.gaussians_from_mesh(ls.sphere(0.6), 300), ls.gaussians_from_mesh(ls.plane(3.2, 3.2), 300)
    both = ls.merge([ball, replace(floor, means=floor.means - np.array((0.0, 0.6, 0.0), np.float32))])
    x, y, z = both.means.T
    albedo = np.where((np.sin(5.0 * x) * np.sin(5.0 * z + 4.0 * y) > 0.0)[:, None], (0.7, 0.6, 0.45), (0.3, 0.2, 0.2))
    truth = replace(both, albedo=albedo, roughness=None, metallic=None)
    lights = [
        ls.LightEnvironment(color=(0.35, 0.4, 0.5)),
        ls.LightDirectional((0.5, -1.0, 0.4), intensity=1.8, angle=0.05),
    ]
    scene = ls.Scene([ls.SplatInstance(truth, material=MATT)], lights=lights)
    trace = ls.TraceConfig(hit_distance=ls.config.HitDistance.MEAN)
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=4, trace=trace, max_bounces=3)
    baked = ls.bake(scene, config, degree=0, directions=16, device="cpu").splats[0].gaussians
    return truth, replace(baked, normals=None)


def test_nine_tenths_of_true_albedos_lie_within_the_intervals_of_delight(
    lit_ball: tuple[ls.Gaussians, ls.Gaussians],
) -> None:
    """Intervals half or twice as wide would hold clearly less or more than 90 %."""
    truth, captured = lit_ball
    found = ls.inverse.estimate_materials(captured, ls.config.DelightConfig(matt=True), device="cpu").gaussians
    assert found.albedo is not None and found.albedo_error is not None and found.normals is not None
    agree = np.einsum("ij,ij->i", found.normals, np.asarray(truth.normals)) > 0.5
    error = np.log(np.asarray(truth.albedo) / np.maximum(found.albedo, 1e-3))[agree]
    error = np.abs(error - np.median(error, axis=0))
    half, whole, twice = (
        float((error <= factor * found.albedo_error[agree, None]).mean()) for factor in (0.5, 1.0, 2.0)
    )
    assert half < 0.9 < whole < 0.97 < twice
