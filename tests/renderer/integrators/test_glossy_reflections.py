"""Reflections in rough surfaces: equal to one-bounce paths, and without counting light twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import lumisplat as ls
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.scene.materials import Material
from support.compare.graph_launcher import GraphLauncher
from support.scenes.lit_scene import ENVIRONMENT, LIGHTS, camera, config, scene
from support.scenes.path_scenes import diffuse

CAMERA = ls.Camera.look_at((0.0, 1.6, 2.6), (0.0, 0.1, 0.0), width=48, height=36, fov_y=0.6)
LIGHT, DAYLIGHT = ls.LightPoint((1.0, 1.5, 2.0), intensity=12.0), ls.LightEnvironment(color=(0.3, 0.5, 0.9))
METAL = ls.MaterialPbr(base_color=(0.9, 0.8, 0.6), metallic=1.0, roughness=0.4)
MATERIALS: dict[str, Material] = {
    "metal": METAL,
    "coat": ls.MaterialPbr(
        base_color=(0.8, 0.6, 0.3), metallic=1.0, roughness=0.5, clearcoat=1.0, clearcoat_roughness=0.2
    ),
    "dielectric": ls.MaterialPbr(base_color=(0.0, 0.0, 0.0), roughness=0.3),
    "phong": ls.MaterialSimple(
        emissive=(0, 0, 0), ambient=(0, 0, 0), diffuse=(0, 0, 0), specular=(0.9, 0.5, 0.2), shininess=20.0
    ),
}
"""Materials without a diffuse part, so that all light of a one-bounce path is in the highlight."""


def floor_and_box(material: Material, *lights: ls.LightPoint | ls.LightEnvironment, splats: bool = False) -> ls.Scene:
    """Returns a grey box on a floor of the given material; the floor is a mesh or a set of Gaussians."""
    floor, box = (replace(mesh, material=of) for mesh, of in ((ls.plane(4.0), material), (ls.box(0.8), diffuse(0.6))))
    instance = ls.MeshInstance(box, position=(0.0, 0.41, -0.4))
    if splats:
        ground = ls.SplatInstance(ls.gaussians_from_mesh(floor, 6000), material=ls.MaterialPbr())
        return ls.Scene([ground], [instance], lights)
    return ls.Scene([], [floor, instance], lights)


def floors_mean(shown: ls.Scene, settings: ls.RenderConfig, seeds: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mean light of the floor beside the box, and its standard error over seeds, shape (3,) each."""
    frames = [ls.render(shown, CAMERA, replace(settings, seed=seed), device="cpu") for seed in range(seeds)]
    beside = ndimage.binary_dilation(frames[0].instance_index == 1, np.ones((3, 3)))
    floor = (frames[0].instance_index == 0) & (np.asarray(beside) == 0)
    means = np.array([frame.color[floor].mean(axis=0, dtype=np.float64) for frame in frames])
    return means.mean(axis=0), means.std(axis=0, ddof=1) / np.sqrt(seeds)


def agree(settings: ls.RenderConfig, shown: ls.Scene, bounces: int = 1) -> None:
    """Asserts that glossy reflections add light and agree with path tracing within four standard errors, below 1 %."""
    first = ls.PathConfig(primary=ls.config.PathPrimary.ISO)
    pathed = replace(settings, pipeline=ls.Pipeline.PATH, samples=10, max_bounces=bounces, path=first)
    (found, error), (expected, off) = floors_mean(shown, settings, 6), floors_mean(shown, pathed, 6)
    either = np.hypot(error, off)
    assert (either < 0.01 * expected).all()
    np.testing.assert_array_less(np.abs(found - expected), 4.0 * either + 1e-4 * expected)
    without, _ = floors_mean(shown, replace(settings, glossy_reflections=False), 2)
    assert (found - without > 10.0 * either).all()


GLOSSY = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=6, glossy_reflections=True, jitter=False)


@pytest.mark.parametrize("name", MATERIALS)
def test_glossy_reflections_on_meshes_equal_one_bounce_path_tracing(name: str) -> None:
    """The scene has a point light and an environment; neither is counted twice."""
    agree(GLOSSY, floor_and_box(MATERIALS[name], LIGHT, DAYLIGHT))


def test_glossy_reflections_on_gaussians_equal_one_bounce_path_tracing() -> None:
    """The floor consists of Gaussians, which must not reflect one another."""
    agree(GLOSSY, floor_and_box(METAL, LIGHT, splats=True))


def test_hybrid_and_trace_pipelines_give_equal_glossy_reflections_on_meshes() -> None:
    """The floor is a mesh, so that both pipelines have the same first hits."""
    shown = floor_and_box(METAL, LIGHT, DAYLIGHT)
    traced = ls.render(shown, CAMERA, replace(GLOSSY, samples=2), device="cpu")
    hybrid = ls.render(shown, CAMERA, replace(GLOSSY, samples=2, pipeline=ls.Pipeline.HYBRID), device="cpu")
    np.testing.assert_allclose(hybrid.color, traced.color, rtol=1e-3, atol=1e-5)


def test_glossy_reflections_of_a_mirror_include_the_environment_it_reflects() -> None:
    """The box is a mirror: only reflection rays reach the environment by way of the box, shadow rays do not."""
    shown = floor_and_box(METAL, DAYLIGHT)
    mirror = ls.MaterialPbr(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)
    (floor, box) = shown.meshes
    agree(GLOSSY, replace(shown, meshes=[floor, replace(box, mesh=replace(box.mesh, material=mirror))]), bounces=2)


@pytest.mark.parametrize("pane", [False, True], ids=["open", "behind clear panes"])
@pytest.mark.parametrize("light", [(DAYLIGHT,), ()], ids=["sky", "background"])
def test_glossy_reflection_rays_do_not_count_environment_light_twice(
    light: tuple[ls.LightEnvironment, ...], pane: bool
) -> None:
    """Without other emitters, rough metals have equal bits with and without reflection rays.

    A pane of glass that neither reflects nor refracts passes all environment light, and hides nothing else.
    """
    floor = replace(ls.plane(4.0), material=METAL)
    clear = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), transmission=1.0, roughness=0.0, ior=1.0, specular=0.0)
    roof = ls.MeshInstance(replace(ls.plane(40.0), material=clear), position=(0.0, 3.0, 0.0))
    shown = ls.Scene([], [floor, roof] if pane else [floor], light)
    settings = replace(GLOSSY, samples=4, lighting=True, background=(1.0, 1.0, 1.0))
    with_rays = ls.render(shown, CAMERA, settings, device="cpu")
    without = ls.render(shown, CAMERA, replace(settings, glossy_reflections=False), device="cpu")
    np.testing.assert_array_equal(with_rays.color, without.color)


def test_rough_floor_reflects_an_emissive_capture() -> None:
    """The frame has no background, so that all light in the reflection comes from the capture."""
    box = ls.gaussians_from_mesh(replace(ls.box(0.8), material=diffuse(0.6)), 3000)
    emissive = ls.SplatInstance(box, position=(0.0, 0.41, -0.4))
    shown = ls.Scene([emissive], [replace(ls.plane(4.0), material=METAL)], [replace(LIGHT, intensity=0.0)])
    seen = ls.render(shown, CAMERA, replace(GLOSSY, background=(1.0, 1.0, 1.0)), device="cpu")
    floor = seen.instance_index == 1
    assert seen.light is not None
    light = seen.light[floor].max(axis=1)
    assert light.max() > 0.1 and np.median(light) < 0.02
    assert (seen.color[floor] > 0.0).any()


def test_glossy_reflections_are_off_by_default_and_without_bounces() -> None:
    """Glossy reflections are also off in rasterised frames, which trace no rays."""
    shown = floor_and_box(METAL, LIGHT)
    plain = ls.render(shown, CAMERA, replace(GLOSSY, glossy_reflections=False), device="cpu")
    none = ls.render(shown, CAMERA, replace(GLOSSY, max_bounces=0), device="cpu")
    np.testing.assert_array_equal(none.color, plain.color)
    assert not ls.RenderConfig().glossy_reflections
    assert not FramePlan.of(replace(GLOSSY, pipeline=ls.Pipeline.RASTER), shown).has_lobes


def test_default_sample_count_with_glossy_reflections_is_16() -> None:
    """The default is 16 even if a point light is the only light."""
    shown = floor_and_box(METAL, LIGHT)
    assert FramePlan.of(replace(GLOSSY, samples=None), shown).samples == 16
    assert FramePlan.of(replace(GLOSSY, samples=None, glossy_reflections=False), shown).samples == 1


def test_reflection_layer_contains_the_light_of_glossy_reflection_rays() -> None:
    """The layer is the image ``reflection`` of the frame."""
    shown = floor_and_box(METAL, LIGHT)
    settings = replace(GLOSSY, samples=4, aovs=("reflection",))
    glossy = ls.render(shown, CAMERA, settings, device="cpu")
    plain = ls.render(shown, CAMERA, replace(settings, glossy_reflections=False), device="cpu")
    assert glossy.reflection is not None and glossy.light is not None and plain.light is not None
    np.testing.assert_allclose(glossy.light - plain.light, glossy.reflection, atol=1e-5)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.HYBRID])
def test_glossy_reflections_do_not_depend_on_thread_count_or_cuda_schedule(pipeline: ls.Pipeline) -> None:
    """The bits are equal for any number of threads; CUDA's schedule with graphs agrees up to rounding."""
    settings = config(pipeline, samples=2, glossy_reflections=True)
    shown = scene(*LIGHTS, ENVIRONMENT)
    frames = [ls.create_renderer(settings, "cpu", threads=n).render(shown, camera()) for n in (1, 2, 5)]
    for frame in frames[1:]:
        np.testing.assert_array_equal(frame.color, frames[0].color)
    replayed = ls.Renderer(settings, GraphLauncher())
    replayed.render(shown, camera())
    again = replayed.render(shown, camera())
    assert np.abs(again.color - frames[0].color).mean() < 1e-3
