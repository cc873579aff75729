"""Pixels where several splat sets overlap show the one whose surface is nearer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.compare.backends import renderer_of
from support.scenes.raster_scenes import flat_sh

CAMERA = ls.Camera.look_at((0.0, 0.7, 2.2), (0.0, 0.15, 0.0), width=80, height=60, fov_y=0.6)
LIGHT = ls.LightDirectional((0.1, -1.0, -0.3), intensity=3.0)
BY_PEAKS = ls.RenderConfig(trace=ls.config.TraceConfig(hit_distance=ls.config.HitDistance.PEAK))


def discs(
    points: np.ndarray, normals: np.ndarray, scales: np.ndarray, color: tuple[float, float, float]
) -> ls.Gaussians:
    """Returns discs of one colour, with opacity 0.95."""
    half = normals + np.array([0.0, 0.0, 1.0])
    quaternions = np.stack([half[:, 2], -half[:, 1], half[:, 0], np.zeros(len(points))], axis=1)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    colors = np.tile(color, (len(points), 1))
    return ls.Gaussians(points, quaternions, scales, np.full(len(points), 0.95), flat_sh(colors))


def wide_floor() -> ls.Gaussians:
    """Returns a floor of 4 x 4 m at y = 0 of 1,500 discs, whose scales are 0.1 to 0.2 m."""
    rng = np.random.default_rng(0)
    x, z = rng.uniform(-2.0, 2.0, (2, 1500))
    normals = np.array([0.0, 1.0, 0.0]) + rng.normal(0.0, 0.03, (1500, 3))
    scales = np.stack([*rng.uniform(0.1, 0.2, (2, 1500)), np.full(1500, 0.005)], axis=1)
    return discs(
        np.stack([x, np.zeros(1500), z], axis=1),
        normals / np.linalg.norm(normals, axis=1)[:, None],
        scales,
        (0.6, 0.4, 0.3),
    )


def ball() -> ls.Gaussians:
    """Returns a ball of radius 0.25 m that stands on the floor, of small discs."""
    y = 1.0 - 2.0 * (np.arange(1500) + 0.5) / 1500
    angle = np.arange(1500) * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - y * y)
    normals = np.stack([ring * np.cos(angle), y, ring * np.sin(angle)], axis=1)
    return discs(0.25 * normals + [0.0, 0.25, 0.0], normals, np.tile([0.018, 0.018, 0.003], (1500, 1)), (0.1, 0.2, 0.8))


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.HYBRID], ids=lambda pipeline: pipeline.value)
@pytest.mark.parametrize("is_lit", [False, True], ids=["captured", "relit"])
def test_ball_on_a_floor_of_wide_gaussians_hides_the_floor_as_in_traced_frames(
    backend: str, pipeline: ls.Pipeline, is_lit: bool
) -> None:
    """The means of the floor's Gaussians are before the ball, where the floor is behind it.

    Captured sets, which rays sort by means unless told otherwise, are told to be sorted by peaks.
    """
    material, lights = (ls.MaterialPbr(), [LIGHT]) if is_lit else (None, [])
    floor, round_ball = (ls.SplatInstance(one, material=material) for one in (wide_floor(), ball()))
    config = ls.RenderConfig(pipeline=pipeline) if is_lit else replace(BY_PEAKS, pipeline=pipeline)
    renderer = renderer_of(backend, config)
    both, alone, without = (
        renderer.render(ls.Scene(sets, lights=lights), CAMERA) for sets in ([floor, round_ball], [round_ball], [floor])
    )
    is_ball = alone.alpha > 0.95
    is_low = is_ball & (np.arange(60) > 24)[:, None]
    assert is_low.sum() > 150
    assert (both.instance_index[is_low] == 1).all()
    tracer = ls.create_renderer(replace(config, pipeline=ls.Pipeline.TRACE), "cpu")
    truth = tracer.render(ls.Scene([floor, round_ball], lights=lights), CAMERA)
    assert np.abs(both.color - truth.color)[is_low].mean() < 0.005
    if not is_lit:
        is_floor = alone.alpha == 0.0
        assert is_floor.mean() > 0.5
        np.testing.assert_array_equal(both.color[is_floor], without.color[is_floor])


def test_captured_sets_keep_the_order_of_means_as_rays_do(renderer: ls.Renderer) -> None:
    """A captured floor that was split into two captures is rasterised like the whole one, to the bit."""
    floor = wide_floor()
    halves = [floor.subset(np.arange(start, 1500, 2)) for start in range(2)]
    whole, cut = (renderer.render(ls.Scene(sets), CAMERA) for sets in ([floor], halves))
    np.testing.assert_array_equal(whole.color, cut.color)


def test_merged_sets_keep_their_own_thresholds_of_the_surface(backend: str) -> None:
    """A ball whose threshold is 0 is never the surface, also where its pixels are merged with those of the floor."""
    both = [wide_floor(), ls.SplatInstance(ball(), depth_iso_transmittance=0.0)]
    frame = renderer_of(backend, BY_PEAKS).render(ls.Scene(both), CAMERA)
    assert not (frame.instance_index == 1).any() and (frame.instance_index == 0).any()


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.HYBRID], ids=lambda pipeline: pipeline.value)
def test_grass_before_a_ball_hides_it_though_the_floor_of_its_set_is_behind(
    backend: str, pipeline: ls.Pipeline
) -> None:
    """Means of the floor's wide Gaussians come before the grass: behind them in its set's order, it must not wait."""
    points = np.stack([np.linspace(-0.2, 0.2, 5), np.full(5, 0.15), np.full(5, 0.4)], axis=1)
    blades = discs(points, np.tile([0.0, 0.0, 1.0], (5, 1)), np.tile([0.04, 0.1, 0.003], (5, 1)), (0.1, 0.7, 0.1))
    meadow = ls.merge([wide_floor().subset(np.arange(300)), blades])
    sets = [ls.SplatInstance(one) for one in (meadow, ball())]
    renderer = renderer_of(backend, replace(BY_PEAKS, pipeline=pipeline))
    both, grass, alone = (renderer.render(ls.Scene(shown), CAMERA) for shown in (sets, [blades], [ball()]))
    tracer = ls.create_renderer(replace(BY_PEAKS, pipeline=ls.Pipeline.TRACE), "cpu")
    truth = tracer.render(ls.Scene(sets), CAMERA)
    hides = (grass.alpha > 0.8) & (alone.alpha > 0.95)
    assert hides.sum() > 30
    assert (both.instance_index[hides] == 0).all()
    assert np.abs(both.color - truth.color)[hides].mean() < 0.01
