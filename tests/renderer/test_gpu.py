"""What only a CUDA device can show; skipped where there is none."""

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
def test_cuda_draws_what_the_cpu_draws(case: scenes.Case) -> None:
    """A CUDA frame equals the CPU's, but for pixels where an alpha lies within rounding of 1/255."""
    cpu = ls.render(case.scene, case.camera, case.config, device="cpu")
    cuda = ls.render(case.scene, case.camera, case.config, device="cuda")
    for name in NAMES:
        difference = np.abs(getattr(cpu, name) - getattr(cuda, name))
        assert np.quantile(difference, 0.99) < 1e-4, name
        assert difference.mean() < 1e-3, name


@pytest.mark.parametrize("case", trace_scenes.cases(), ids=lambda case: case.name)
def test_cuda_traces_what_the_cpu_traces(case: scenes.Case) -> None:
    """A traced CUDA frame equals the CPU's, but where a decision lies within rounding."""
    cpu = ls.render(case.scene, case.camera, case.config, device="cpu")
    cuda = ls.render(case.scene, case.camera, case.config, device="cuda")
    for name in NAMES:
        difference = np.abs(getattr(cpu, name) - getattr(cuda, name))
        assert np.quantile(difference, 0.99) < 1e-3, name
        assert difference.mean() < 1e-3, name


@pytest.mark.parametrize("pipeline", list(ls.Pipeline))
def test_cuda_lights_what_the_cpu_lights(pipeline: ls.Pipeline) -> None:
    """A lit CUDA frame, with soft shadows, mirrors and glass, equals the CPU's but where a decision is rounding's."""
    samples = 1 if pipeline is ls.Pipeline.REALTIME else 2
    config = lit_scene.config(pipeline, shadows=ls.Shadows.SOFT, samples=samples)
    scene, camera = lit_scene.scene(*lit_scene.LAMPS, lit_scene.SKY), lit_scene.camera()
    cpu, cuda = (ls.render(scene, camera, config, device=device) for device in ("cpu", "cuda"))
    for name in ("color", "captured", "light", "alpha"):
        difference = np.abs(getattr(cpu, name) - getattr(cuda, name))
        assert np.quantile(difference, 0.98) < 1e-3, name
        assert difference.mean() < 2e-3, name


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.TRACE, ls.Pipeline.HYBRID])
def test_captures_come_out_of_cuda_as_they_went_in(pipeline: ls.Pipeline) -> None:
    """Where nothing reflects, a lit frame is the unlit one: to the rounding of kernels that are compiled apart."""
    scene, camera = ls.Scene([scenes.random_gaussians(71, 300, degree=2)], (), lit_scene.LAMPS), lit_scene.camera()
    config = ls.RenderConfig(pipeline=pipeline, background=(0.2, 0.3, 0.4), lighting=True)
    frame = ls.render(scene, camera, config, device="cuda")
    unlit = ls.render(scene, camera, replace(config, lighting=False), device="cuda")
    assert unlit.color.std() > 0.05 and frame.captured is not None
    np.testing.assert_allclose(frame.captured, unlit.color, rtol=0.0, atol=2e-6)
    np.testing.assert_array_equal(frame.light, 0.0)


@pytest.mark.parametrize("degree", [2, 4])
def test_cuda_differentiates_rays_as_the_cpu_does(degree: int) -> None:
    """Frames of rays, by all parameters and by the pose; the same bits again."""
    scene, camera = ls.Scene([replace(gradient_scenes.cloud(count=60), kernel_degree=degree)]), gradient_scenes.view()
    found: list[ls.gradients.SplatGradients] = []
    for device in ("cpu", "cuda", "cuda"):
        renderer = ls.DifferentiableRenderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE), device)
        for _ in range(3):  # the third is from a graph
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
def test_cuda_rasterises_along_rays_as_the_cpu_does(name: str) -> None:
    """Frames of lenses, and their derivatives, but for the order of sums."""
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
    assert np.abs(poses[0] - poses[1]).max() < 5e-3 * np.abs(poses[0]).max()  # pixels at a threshold pull on all of it


def test_graph_repeats_the_direct_frame() -> None:
    """The third frame, replayed as a graph, is bit-equal to the first; a moved camera moves the replay too."""
    case = scenes.cases()[3]
    renderer = ls.create_renderer(case.config, "cuda")
    first = renderer.render(case.scene, case.camera)
    moved = scenes.front_camera(cx=30.0)
    for _ in range(3):
        again = renderer.render(case.scene, case.camera)
        np.testing.assert_array_equal(first.color, again.color)
    expected = ls.render(case.scene, moved, case.config, device="cuda")
    np.testing.assert_array_equal(renderer.render(case.scene, moved).color, expected.color)


def test_profiled_frame_times_its_stages() -> None:
    """Profiling reports every stage and changes nothing."""
    case = scenes.cases()[3]
    plain = ls.create_renderer(case.config, "cuda").render(case.scene, case.camera)
    profiled = ls.create_renderer(case.config, "cuda", profile=True).render(case.scene, case.camera)
    np.testing.assert_array_equal(plain.color, profiled.color)
    assert profiled.stats is not None
    assert {"project", "sort", "bin", "composite"} <= profiled.stats.stage_ms.keys()


@pytest.mark.parametrize("light", [(0.5, -3.0, 1.0), ls.LightDirectional((0.2, 1.0, 0.1))], ids=["point", "parallel"])
def test_cuda_shadows_what_the_cpu_shadows(light: object) -> None:
    """A deep shadow map on CUDA is the CPU's, to float32's rounding."""
    casters, receivers = scenes.random_gaussians(1, 200), scenes.random_gaussians(2, 2000, extent=(4.0, 4.0, 4.0))
    seen = [
        ls.DeepShadowMap.build(casters, light, receivers, device=device).transmittance_of(receivers)
        for device in ("cpu", "cuda")
    ]
    assert seen[0].min() < 0.5
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-4)


def test_derivatives_are_taken_from_arrays_on_the_gpu() -> None:
    """By DLPack, as tensors of other packages are."""
    scene, camera = ls.Scene([scenes.random_gaussians(3, 60)]), scenes.front_camera()
    pull = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
    there: Any = wp.array(pull, dtype=wp.float32, device="cuda:0")  # pyright: ignore[reportArgumentType]
    found, expected = (ls.splat_gradients(scene, camera, array, device="cuda").sets[0].means for array in (there, pull))
    assert np.abs(expected).max() > 0.0
    np.testing.assert_array_equal(found, expected)
