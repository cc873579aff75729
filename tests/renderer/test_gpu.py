"""Tests that need a CUDA device; skipped without one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.scenes import gradient_scenes, lenses, lit_scene, raster_scenes as scenes, trace_scenes

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(wp.get_cuda_device_count() == 0, reason="no CUDA device"),
]

NAMES = ("color", "alpha", "normal")


@pytest.mark.parametrize("case", scenes.cases(), ids=lambda case: case.name)
def test_raster_frames_of_cuda_and_cpu_are_equal(case: scenes.Case) -> None:
    """Pixels may differ where an alpha is within rounding of 1/255."""
    cpu = ls.render(case.scene, case.camera, case.config, device="cpu")
    cuda = ls.render(case.scene, case.camera, case.config, device="cuda")
    for name in NAMES:
        difference = np.abs(getattr(cpu, name) - getattr(cuda, name))
        assert np.quantile(difference, 0.99) < 1e-4, name
        assert difference.mean() < 1e-3, name


@pytest.mark.parametrize("case", trace_scenes.cases(), ids=lambda case: case.name)
def test_traced_frames_of_cuda_and_cpu_are_equal(case: scenes.Case) -> None:
    """Pixels may differ where rounding decides which surface is hit."""
    cpu = ls.render(case.scene, case.camera, case.config, device="cpu")
    cuda = ls.render(case.scene, case.camera, case.config, device="cuda")
    for name in NAMES:
        difference = np.abs(getattr(cpu, name) - getattr(cuda, name))
        assert np.quantile(difference, 0.99) < 1e-3, name
        assert difference.mean() < 1e-3, name


@pytest.mark.parametrize("pipeline", list(ls.Pipeline))
def test_lit_frames_of_cuda_and_cpu_are_equal(pipeline: ls.Pipeline) -> None:
    """The frame has soft shadows, mirrors and glass; pixels may differ where rounding decides which surface is hit."""
    samples = 1 if pipeline is ls.Pipeline.REALTIME else 2
    config = lit_scene.config(pipeline, shadows=ls.Shadows.SOFT, samples=samples)
    scene, camera = lit_scene.scene(*lit_scene.LIGHTS, lit_scene.ENVIRONMENT), lit_scene.camera()
    cpu, cuda = (ls.render(scene, camera, config, device=device) for device in ("cpu", "cuda"))
    for name in ("color", "captured", "light", "alpha"):
        difference = np.abs(getattr(cpu, name) - getattr(cuda, name))
        assert np.quantile(difference, 0.98) < 1e-3, name
        assert difference.mean() < 2e-3, name


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.TRACE, ls.Pipeline.HYBRID])
def test_lit_frame_on_cuda_of_captures_without_materials_equals_the_unlit_frame(pipeline: ls.Pipeline) -> None:
    """Without reflecting surfaces, lit and unlit frames differ by the rounding of separately compiled kernels."""
    scene, camera = ls.Scene([scenes.random_gaussians(71, 300, degree=2)], (), lit_scene.LIGHTS), lit_scene.camera()
    config = ls.RenderConfig(pipeline=pipeline, background=(0.2, 0.3, 0.4), lighting=True)
    frame = ls.render(scene, camera, config, device="cuda")
    unlit = ls.render(scene, camera, replace(config, lighting=False), device="cuda")
    assert unlit.color.std() > 0.05 and frame.captured is not None
    np.testing.assert_allclose(frame.captured, unlit.color, rtol=0.0, atol=2e-6)
    np.testing.assert_array_equal(frame.light, 0.0)


@pytest.mark.parametrize("degree", [2, 4])
def test_ray_gradients_of_cuda_and_cpu_are_equal(degree: int) -> None:
    """All parameters and the pose are compared; repeated gradients are equal to the bit."""
    scene, camera = ls.Scene([replace(gradient_scenes.cloud(count=60), kernel_degree=degree)]), gradient_scenes.view()
    found: list[ls.gradients.SplatGradients] = []
    for device in ("cpu", "cuda", "cuda"):
        renderer = ls.DifferentiableRenderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE), device)
        for _ in range(3):  # the third frame is replayed from a graph
            renderer.render(scene, camera)
        found.append(renderer.gradients(*gradient_scenes.by_pixels(camera), pose=True))
    cpu, cuda, again = map(gradient_scenes.vars_of, found)
    for name, value in cpu.items():
        assert np.abs(cuda[name] - value).max() < 1e-3 * np.abs(value).mean(), name
        np.testing.assert_array_equal(cuda[name], again[name])
    poses = [one.camera_from_world for one in found]
    assert poses[0] is not None and poses[1] is not None
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-3 * np.abs(poses[0]).max())


@pytest.mark.parametrize("name", ["phone", "fisheye of 220 degrees", "rolling shutter"])
def test_unscented_frames_and_gradients_of_cuda_and_cpu_are_equal(name: str) -> None:
    """Frames and gradients of all lenses are equal up to the order of sums."""
    camera = lenses.LENSES[name]
    scene = ls.Scene([scenes.random_gaussians(13, count=60, degree=1, center=(0.0, 0.0, 2.5))])
    found: list[ls.gradients.SplatGradients] = []
    frames: list[ls.Frame] = []
    for device in ("cpu", "cuda"):
        config = ls.RenderConfig(raster=ls.RasterConfig(projection=ls.config.Projection.UNSCENTED))
        renderer = ls.DifferentiableRenderer(config, device)
        frames.append(renderer.render(scene, camera))
        found.append(renderer.gradients(*gradient_scenes.by_pixels(camera), pose=True))
    difference = np.abs(frames[0].color - frames[1].color)
    assert np.quantile(difference, 0.99) < 1e-4 and difference.mean() < 1e-4
    cpu, cuda = map(gradient_scenes.vars_of, found)
    for key, value in cpu.items():
        error = np.abs(value - cuda[key])
        assert np.quantile(error, 0.98) < 1e-3 * np.abs(value).mean(), key
    poses = [one.camera_from_world for one in found]
    assert poses[0] is not None and poses[1] is not None
    assert np.abs(poses[0] - poses[1]).max() < 5e-3 * np.abs(poses[0]).max()  # all pixels affect the pose


def test_frame_replayed_from_a_cuda_graph_equals_one_launched_directly_to_the_bit() -> None:
    """The third frame is a replay, equals the first to the bit, and follows a moved camera."""
    case = scenes.cases()[3]
    renderer = ls.create_renderer(case.config, "cuda")
    first = renderer.render(case.scene, case.camera)
    moved = scenes.front_camera(cx=30.0)
    for _ in range(3):
        again = renderer.render(case.scene, case.camera)
        np.testing.assert_array_equal(first.color, again.color)
    expected = ls.render(case.scene, moved, case.config, device="cuda")
    np.testing.assert_array_equal(renderer.render(case.scene, moved).color, expected.color)


def test_profiling_on_cuda_times_every_stage_and_changes_no_pixel() -> None:
    """The profile contains every stage of the frame."""
    case = scenes.cases()[3]
    plain = ls.create_renderer(case.config, "cuda").render(case.scene, case.camera)
    profiled = ls.create_renderer(case.config, "cuda", profile=True).render(case.scene, case.camera)
    np.testing.assert_array_equal(plain.color, profiled.color)
    assert profiled.stats is not None
    assert {"project", "sort", "bin", "composite"} <= profiled.stats.stage_ms.keys()


@pytest.mark.parametrize("light", [(0.5, -3.0, 1.0), ls.LightDirectional((0.2, 1.0, 0.1))], ids=["point", "parallel"])
def test_deep_shadow_maps_of_cuda_and_cpu_are_equal(light: object) -> None:
    """The transmittances agree up to float32 rounding."""
    casters, receivers = scenes.random_gaussians(1, 200), scenes.random_gaussians(2, 2000, extent=(4.0, 4.0, 4.0))
    seen = [
        ls.DeepShadowMap.build(casters, light, receivers, device=device).transmittance_of(receivers)
        for device in ("cpu", "cuda")
    ]
    assert seen[0].min() < 0.5
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-4)


def test_gradient_functions_accept_arrays_on_the_gpu() -> None:
    """The arrays are read by DLPack, like tensors of other packages."""
    scene, camera = ls.Scene([scenes.random_gaussians(3, 60)]), scenes.front_camera()
    pull = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    there: Any = wp.array(pull, dtype=wp.float32, device="cuda:0")  # pyright: ignore[reportArgumentType]
    found, expected = (ls.splat_gradients(scene, camera, array, device="cuda").sets[0].means for array in (there, pull))
    assert np.abs(expected).max() > 0.0
    np.testing.assert_array_equal(found, expected)
