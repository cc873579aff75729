"""Ray queries: radiance, transmittance, and refused input."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer import rays as rays_module
from support.scenes.raster_scenes import front_camera, joined, one_gaussian, quad, random_gaussians

AHEAD = np.array([[0.0, 0.0, 1.0]])
ORIGIN = np.zeros((1, 3))


def tracer(**trace: object) -> ls.Renderer:
    """Returns a renderer that traces on the CPU."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False, trace=replace(ls.TraceConfig(), **trace))
    return ls.create_renderer(config, "cpu")


def stack(*opacities: float) -> ls.Gaussians:
    """Returns Gaussians centred on the axis at z = 3, 4, 5 and so on."""
    return joined(*(one_gaussian((0.0, 0.0, 3.0 + i), opacity=opacity) for i, opacity in enumerate(opacities)))


@pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.PATH])
def test_query_of_zero_rays_in_a_lit_scene_returns_empty_arrays(pipeline: ls.Pipeline) -> None:
    """Arrays of radiance and hits have no rows."""
    scene = ls.Scene([stack(0.5)], [quad(4.0)], [ls.LightPoint((0.0, 0.0, 0.0))])
    none = np.zeros((0, 3))
    hits = ls.trace_rays(scene, none, none, ls.RenderConfig(pipeline=pipeline), device="cpu")
    assert hits.radiance.shape == (0, 3) and len(hits) == 0


def test_queried_transmittance_of_a_segment_is_the_product_over_gaussians_before_its_end() -> None:
    """The product is over the Gaussians whose mean is in front of the end of the ray."""
    scene = ls.Scene([stack(0.5, 0.8, 0.3)])
    distances = np.array([2.5, 3.5, 4.5, 5.5, math.inf])
    through = ls.transmittance(scene, np.zeros((5, 3)), np.repeat(AHEAD, 5, axis=0), distances, device="cpu")
    np.testing.assert_allclose(through, [1.0, 0.5, 0.1, 0.07, 0.07], rtol=1e-5)
    assert ls.transmittance(scene, ORIGIN, AHEAD, 3.5, device="cpu") == pytest.approx(0.5, rel=1e-5)


def test_queried_transmittance_of_a_ray_equals_that_of_blending_its_sorted_hits() -> None:
    """The product in any order equals the transmittance of sorted rays, except below the minimum transmittance."""
    rng = np.random.default_rng(5)
    scene = ls.Scene([random_gaussians(70, count=400)])
    origins, directions = rng.normal((0.0, 0.0, 4.0), 2.0, (500, 3)), rng.normal(size=(500, 3))
    through = ls.transmittance(scene, origins, directions, device="cpu")
    hits = tracer(transmittance_min=0.0).trace_rays(scene, origins, directions)
    assert (through < 0.9).mean() > 0.2
    np.testing.assert_allclose(through, hits.transmittance, atol=2e-4)


def test_mesh_before_the_end_of_a_segment_makes_its_queried_transmittance_0() -> None:
    """A mesh of any material blocks; a segment that ends in front of the mesh is not blocked."""
    glass = ls.MaterialPbr(transmission=1.0, roughness=0.0)
    scene = ls.Scene([stack(0.5)], [quad(4.0, material=glass)])
    aside = np.array([0.3, 0.2, 0.0])
    for distance, expected in ((3.5, 1.0), (4.5, 0.0)):
        through = ls.transmittance(scene, ORIGIN + aside * 2.0, AHEAD, distance, device="cpu")
        assert through == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("hit_distance", list(ls.config.HitDistance))
def test_gaussian_whose_peak_is_behind_a_wall_adds_no_colour_and_no_shadow(hit_distance: ls.config.HitDistance) -> None:
    """The hull of the Gaussian reaches through the wall."""
    behind = ls.Scene([one_gaussian((0.0, 0.0, 5.0), 0.5, opacity=0.95)], [quad(4.0, material=ls.MaterialPbr())])
    renderer = tracer(hit_distance=hit_distance)
    hits = renderer.trace_rays(behind, [[0.1, 0.05, 0.0]], AHEAD)
    assert hits.depth == pytest.approx(4.0)
    assert hits.instance_index == 1
    alone = ls.Scene(behind.splats)
    assert renderer.transmittance(alone, ORIGIN, AHEAD, 4.0) == pytest.approx(1.0)
    assert renderer.transmittance(alone, ORIGIN, AHEAD, 5.5) < 0.1


def test_queried_rays_through_pixels_have_the_colours_of_a_frame() -> None:
    """The frame is traced without footprint; the rays have any length and order."""
    scene, camera = ls.Scene([random_gaussians(71)], [quad(4.0, 0.6, tilt=0.3)]), front_camera()
    frame = tracer(dilation=0.0).render(scene, camera)
    directions = camera.ray_directions().reshape(-1, 3) @ camera.camera_from_world[:3, :3]
    order = np.random.default_rng(6).permutation(len(directions))
    lengths = np.exp(np.random.default_rng(7).uniform(-50.0, 50.0, (len(directions), 1)))
    hits = tracer().trace_rays(scene, np.zeros((len(directions), 3)), (directions * lengths)[order])
    close = np.abs(hits.radiance - frame.color.reshape(-1, 3)[order]).max(axis=1) < 1e-4
    assert close.mean() > 0.99
    np.testing.assert_allclose(1.0 - hits.transmittance, frame.alpha.reshape(-1)[order], atol=2e-3)


def test_results_of_ray_queries_do_not_depend_on_the_batch_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Batches of 64 rays give the results of one batch, including random numbers, with the memory of a batch."""
    scene = ls.Scene([random_gaussians(72)])
    rng = np.random.default_rng(8)
    origins, directions = rng.normal(size=(1000, 3)), rng.normal((0.0, 0.0, 3.0), 1.0, (1000, 3))
    for strategy in ls.config.TraceStrategy:
        whole = tracer(strategy=strategy).trace_rays(scene, origins, directions)
        with monkeypatch.context() as patch:
            patch.setattr(rays_module, "RAY_BATCH", 64)
            parts = tracer(strategy=strategy).trace_rays(scene, origins, directions)
        np.testing.assert_array_equal(parts.radiance, whole.radiance)
        np.testing.assert_array_equal(parts.depth, whole.depth)


def test_ray_queries_of_different_numbers_of_rays_reuse_the_buffers_of_the_largest() -> None:
    """Queries of many different numbers of rays use the buffers of the largest."""
    renderer, scene = tracer(), ls.Scene([stack(0.5)])
    renderer.trace_rays(scene, np.zeros((900, 3)), np.repeat(AHEAD, 900, axis=0))
    allocations, views = renderer._buffers.allocations, len(renderer._buffers._views)
    for count in range(1, 900, 37):
        renderer.trace_rays(scene, np.zeros((count, 3)), np.repeat(AHEAD, count, axis=0))
    assert renderer._buffers.allocations == allocations
    assert len(renderer._buffers._views) == views


def test_ray_query_uses_a_single_origin_for_all_directions() -> None:
    """The result equals that of an origin repeated for each ray."""
    scene, directions = ls.Scene([random_gaussians(73)]), np.random.default_rng(9).normal((0, 0, 3), 1.0, (50, 3))
    one, many = (ls.trace_rays(scene, o, directions, device="cpu") for o in ((0, 0, 1), np.tile((0, 0, 1), (50, 1))))
    np.testing.assert_array_equal(one.radiance, many.radiance)


def test_ray_and_transmittance_queries_of_zero_rays_raise_no_error() -> None:
    """The functions return empty arrays."""
    hits = ls.trace_rays(ls.Scene([stack(0.5)]), np.zeros((0, 3)), np.zeros((0, 3)), device="cpu")
    assert len(hits) == 0 and hits.radiance.shape == (0, 3)
    assert ls.transmittance(ls.Scene(), np.zeros((0, 3)), np.zeros((0, 3)), device="cpu").shape == (0,)


def test_ray_whose_colour_overflows_is_black_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    """A log line counts such rays."""
    wild = ls.Gaussians([[0.0, 0.0, 3.0]], [[1, 0, 0, 0]], [[0.2] * 3], [0.9], np.full((1, 16, 3), 3e38))
    hits = ls.trace_rays(ls.Scene([wild]), np.zeros((2, 3)), [[0, 0, 1], [0, 0, -1]], device="cpu")
    np.testing.assert_array_equal(hits.radiance, 0.0)
    assert "1 samples of 2 rays were not finite" in caplog.text


@pytest.mark.parametrize(
    ("origins", "directions", "message"),
    [
        (np.zeros((3, 3)), [[0, 0, 1], [0, 0, 0], [0, 0, 0]], "2 of 3 ray directions have no length"),
        (np.zeros((2, 3)), [[0, 0, math.nan], [0, 0, 1]], "1 of 2 ray directions are not finite"),
        ([[math.inf, 0, 0]], AHEAD, "1 of 1 ray origins are not finite"),
        ([[1e39, 0, 0]], AHEAD, "1 of 1 ray origins are not finite"),
        (np.zeros(2), AHEAD, r"ray origins have shape \(2,\), expected \(N, 3\)"),
        (ORIGIN, [[0, 1]], r"ray directions have shape \(1, 2\)"),
        (np.zeros((2, 3)), AHEAD, "2 origins and 1 directions"),
        ("here", AHEAD, "origins are not numbers"),
        (ORIGIN, [[1j, 0, 0]], "directions are not numbers"),
    ],
)
def test_ray_queries_refuse_invalid_origins_and_directions(origins: Any, directions: Any, message: str) -> None:
    """One message counts the invalid rays, without NumPy warnings."""
    with warnings.catch_warnings(), pytest.raises(ls.SceneError, match=message):
        warnings.simplefilter("error")
        ls.trace_rays(ls.Scene([stack(0.5)]), origins, directions, device="cpu")


@pytest.mark.parametrize(
    ("distance", "message"),
    [
        (-1.0, "1 of 1 values of max_distance are negative or NaN"),
        (math.nan, "negative or NaN"),
        ([1.0, 2.0], r"max_distance has shape \(2,\), expected one number or \(1,\)"),
        ("far", "max_distance are not numbers"),
    ],
)
def test_ray_queries_refuse_invalid_maximum_distances(distance: Any, message: str) -> None:
    """One message counts the invalid distances, without NumPy warnings."""
    with pytest.raises(ls.SceneError, match=message):
        ls.transmittance(ls.Scene([stack(0.5)]), ORIGIN, AHEAD, distance, device="cpu")


def test_renderer_of_the_raster_pipeline_refuses_ray_queries() -> None:
    """The message names the pipelines that trace rays."""
    with pytest.raises(ls.ConfigError, match=r"a renderer with Pipeline\.TRACE"):
        ls.create_renderer(device="cpu").trace_rays(ls.Scene([stack(0.5)]), ORIGIN, AHEAD)


@pytest.mark.data
def test_result_of_a_queried_ray_does_not_depend_on_other_rays(data_dir: Path) -> None:
    """Parallel rays through a capture have equal results alone and together."""
    capture = ls.load(data_dir / "splats" / "biker.compressed.ply")
    assert isinstance(capture, ls.Gaussians)
    rng = np.random.default_rng(9)
    origins = rng.uniform(capture.means.min(axis=0), capture.means.max(axis=0), (320, 3))
    directions = np.repeat([[0.2, -0.9, 0.1]], 320, axis=0)
    renderer, scene = tracer(), ls.Scene([capture])
    together = renderer.trace_rays(scene, origins, directions)
    alone = [renderer.trace_rays(scene, origins[i : i + 1], directions[:1]).radiance[0] for i in range(40)]
    np.testing.assert_allclose(together.radiance[:40], alone, atol=2e-6)


def test_repr_of_ray_hits_is_one_line() -> None:
    """The line has the numbers of rays and hits, and the range of depths if there are hits."""
    scene = ls.Scene([], [quad(4.0)])
    origins, away = np.zeros((3, 3)), np.array([[0.0, 0.0, 1.0], [0.0, 0.1, 1.0], [0.0, 0.0, -1.0]])
    hits = tracer().trace_rays(scene, origins, away)
    assert repr(hits) == "RayHits(rays=3, hits=2, depth=4..4.02, color_space='srgb')"
    assert repr(tracer().trace_rays(scene, ORIGIN, -AHEAD)) == "RayHits(rays=1, hits=0, color_space='srgb')"
