"""Relit sets among emissive captures: hits in each set's order, compared with brute force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.compare.backends import LISTS_AND_BVHS, renderer_of
from support.oracles.particle_oracle import hits, world_of
from support.oracles.trace_oracle import camera_rays
from support.scenes.raster_scenes import random_gaussians, similarity
from support.scenes.trace_scenes import small_camera

MEAN, PEAK = ls.config.HitDistance.MEAN, ls.config.HitDistance.PEAK


def mixed_scene() -> ls.Scene:
    """Returns eight interpenetrating instances of all sizes, every other one relit."""
    instances: list[ls.SplatInstance] = []
    for number in range(8):
        random = np.random.default_rng(number)
        scale = 10.0 ** random.uniform(-2.0, 2.0)
        gaussians = random_gaussians(
            number, 40, center=(0.0, 0.0, 0.0), extent=(0.8, 0.8, 0.8), scale_range=(0.02, 0.5)
        )
        gaussians = replace(gaussians, means=gaussians.means / scale, scales=gaussians.scales / scale)
        position = (random.uniform(-1.0, 1.0), random.uniform(-1.0, 1.0), random.uniform(1.0, 5.0))
        axis = tuple(random.normal(size=3).tolist())
        material = ls.MaterialPbr(roughness=0.6) if number % 2 else None
        instances.append(
            ls.SplatInstance(gaussians, similarity(axis, random.uniform(0.0, 3.0), scale, position), material=material)
        )
    return ls.Scene(instances, [], [ls.LightPoint((0.0, -2.0, 1.0), intensity=30.0)])


def expected_weights(scene: ls.Scene, camera: ls.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Returns the blend weight of emissive sets in each pixel, ordered by means, and the total transmittance.

    Relit sets are ordered by peaks.
    """
    worlds = {
        order: world_of(scene, ls.RenderConfig(trace=ls.TraceConfig(hit_distance=order, transmittance_min=0.0)))
        for order in (MEAN, PEAK)
    }
    rows: list[tuple[float, float]] = []
    for ray in camera_rays(camera):
        t, index, alpha = [], [], []
        for order, world in worlds.items():
            found = hits(world, ray)
            selected = found.counts & ((world.instance[found.index] % 2 == 1) == (order is PEAK))
            t, index, alpha = (
                [*t, *found.t[selected]],
                [*index, *found.index[selected]],
                [*alpha, *found.alpha[selected]],
            )
        sequence = np.lexsort((index, t))
        alphas, relit = np.array(alpha)[sequence], worlds[MEAN].instance[np.array(index, int)[sequence]] % 2 == 1
        through = np.cumprod(np.concatenate([[1.0], 1.0 - alphas]))
        rows.append((float((through[:-1] * alphas)[~relit].sum()), float(through[-1])))
    weights = np.array(rows).reshape(camera.height, camera.width, 2)
    return weights[..., 0], weights[..., 1]


@LISTS_AND_BVHS
@pytest.mark.parametrize("backend", ["cpu", "cpu as cuda"])
@pytest.mark.parametrize("k", [4, 16])
def test_ray_tracer_sorts_emissive_gaussians_by_means_and_relit_ones_by_peaks(
    backend: str, k: int, lists: bool
) -> None:
    """Ordering all sets by peaks would change the blend weights by more than 0.01."""
    scene, camera = mixed_scene(), small_camera(30, 22, 24.0, near=0.05)
    trace = ls.TraceConfig(hits_per_pass=k, transmittance_min=0.0)
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=True, shadows=ls.Shadows.OFF, samples=1, trace=trace)
    frame = renderer_of(backend, config, lists=lists).render(scene, camera)
    captured, through = expected_weights(scene, camera)
    assert 0.1 < captured.mean() < 0.9 and through.mean() < 0.7
    assert frame.captured_weight is not None
    # The captured weight includes the background, which is display-referred, too.
    np.testing.assert_allclose(frame.captured_weight, captured + through, atol=2e-5)
    one_order = replace(config, trace=replace(trace, hit_distance=PEAK))
    other = renderer_of(backend, one_order).render(scene, camera).captured_weight
    assert other is not None and np.abs(other - frame.captured_weight).max() > 0.01
