"""Path tracing compared with the other pipelines, and changes that must not change it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.lights import Light
from support.scenes.lit_scene import ENVIRONMENT, LIGHTS, camera, config, scene
from support.scenes.path_scenes import as_splats, ball, cube_without_ceiling, diffuse, paths, quad
from support.scenes.raster_scenes import one_gaussian

LIGHTS_BY_NAME: dict[str, Light] = {
    "point": ls.LightPoint((0.4, 0.8, -0.5), intensity=0.6),
    "sphere": ls.LightSphere((0.4, 0.8, -0.5), 0.1, intensity=20.0, visible=False),
    "rect": ls.LightRect((0.4, 0.9, -0.2), (0.3, 0, 0), (0, 0, 0.3), intensity=9.0),
    "sky": ls.LightEnvironment(color=(0.5, 0.7, 1.0), visible=False),
}


def balls(kind: str) -> ls.Scene:
    """Returns a ball floating over a floor."""
    floor = quad((-1, -0.4, -1), (0, 0, 2), (2, 0, 0), diffuse(0.6))
    shape = ball(0.3, diffuse(0.7), rows=32)
    if kind == "mesh":
        return ls.Scene(meshes=[floor, shape])
    return ls.Scene(meshes=[floor], splats=[as_splats(shape, 6000)])


@pytest.mark.parametrize("kind", ["mesh", "gaussians"])
@pytest.mark.parametrize("light", LIGHTS_BY_NAME.values(), ids=LIGHTS_BY_NAME.keys())
def test_path_tracing_without_bounces_has_the_mean_of_the_trace_pipelines_direct_light(light: Light, kind: str) -> None:
    """The trace pipeline uses stochastic hits."""
    lit = replace(balls(kind), lights=[light])
    view = ls.Camera.look_at((0.3, 0.6, -1.4), (0.0, -0.1, 0.0), width=48, height=36, fov_y=0.7)
    traced = ls.RenderConfig(
        pipeline=ls.Pipeline.TRACE,
        trace=ls.TraceConfig(strategy=ls.config.TraceStrategy.STOCHASTIC_HIT),
        shadows=ls.Shadows.SOFT,
        samples=64,
    )
    expected = ls.render(lit, view, traced, device="cpu").color
    found = paths(lit, view, 64, 0).color
    assert expected.mean() > 0.02
    np.testing.assert_allclose(found.mean(axis=(0, 1)), expected.mean(axis=(0, 1)), rtol=4e-3)
    blocks = [image.reshape(9, 4, 12, 4, 3).mean(axis=(1, 3)) for image in (found, expected)]
    np.testing.assert_allclose(*blocks, rtol=0.06, atol=0.004)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_path_traced_frames_do_not_depend_on_thread_count(threads: int) -> None:
    """The bits are equal, with light that bounces between Gaussians, meshes, mirrors and glass."""
    settings = config(ls.Pipeline.PATH, samples=3, max_bounces=5)
    shown = scene(*LIGHTS, ENVIRONMENT)
    frames = [ls.create_renderer(settings, "cpu", threads=n).render(shown, camera()) for n in (threads, 2)]
    np.testing.assert_array_equal(frames[0].color, frames[1].color)


def test_light_of_an_emissive_square_does_not_depend_on_its_tessellation() -> None:
    """The square is one quad, many triangles of many sizes, or two instances."""
    room = cube_without_ceiling(diffuse(0.5))
    view = ls.Camera.look_at((0.5, 0.8, 0.5), (0.5, 0.0, 0.5), (0, 0, 1), width=32, height=32, fov_y=0.03)
    emissive = diffuse(0.5, 1.0)
    whole = [quad((0.2, 0.9, 0.2), (0.6, 0, 0), (0, 0, 0.6), emissive)]
    edges = np.array([0.0, 0.01, 0.1, 0.15, 0.6])
    cut = [
        quad((0.2 + x, 0.9, 0.2), (w, 0, 0), (0, 0, 0.6), emissive)
        for x, w in zip(edges[:-1], np.diff(edges), strict=True)
    ]
    halves = quad((0.2, 0.9, 0.2), (0.3, 0, 0), (0, 0, 0.6), emissive)
    moved = np.eye(4)
    moved[0, 3] = 0.3
    twice = [ls.MeshInstance(halves), ls.MeshInstance(halves, moved)]
    means = [paths(ls.Scene(meshes=[*room, *shape]), view, 32, 2).color.mean() for shape in (whole, cut, twice)]
    np.testing.assert_allclose(means, means[0], rtol=0.01)


def test_path_tracer_does_not_render_gaussians_in_front_of_the_near_plane() -> None:
    """The Gaussians are small and in front of the near plane; traced frames leave them out as well."""
    speck = one_gaussian((0.0, 0.0, 0.05), 0.002, 0.99, (0.9, 0.1, 0.1))
    wall = one_gaussian((0.0, 0.0, 2.0), (2.0, 2.0, 0.01), 0.99, (0.2, 0.4, 0.8))
    camera = ls.Camera.look_at((0, 0, 0), (0, 0, 1), width=8, height=8, fov_y=0.02, near=0.2)
    capture = ls.Scene(splats=[speck, wall])
    red = paths(capture, camera, 32, 1).color[..., 0].mean()
    seen = paths(capture, replace(camera, near=0.01), 32, 1).color[..., 0].mean()
    assert red < 0.05
    assert seen > 0.5


def test_path_traced_scene_in_which_nothing_emits_light_has_a_headlight() -> None:
    """Relit captures emit nothing; a scene with emissive captures or meshes needs no headlight."""
    relit = ls.Scene(splats=[as_splats(ball(0.3, diffuse(0.7), rows=32), 4000)])
    view = ls.Camera.look_at((0.0, 0.0, -1.4), (0.0, 0.0, 0.0), width=32, height=24, fov_y=0.3)
    assert paths(relit, view, 8, 2).color[10:14, 14:18].mean() > 0.4
    with_emissive = replace(relit, splats=[*relit.splats, one_gaussian((9.0, 0.0, 0.0), 0.1, 0.9, (0.5, 0.5, 0.5))])
    assert paths(with_emissive, view, 8, 2).color.max() < 0.05
    assert paths(with_emissive, view, 8, 2, lighting=True).color[10:14, 14:18].mean() > 0.4


def test_path_traced_ray_queries_include_the_light_of_emissive_meshes() -> None:
    """Rays through a camera's pixels equal the frame; an emissive mesh is the only light."""
    room = [*cube_without_ceiling(diffuse(0.5)), quad((0, 1, 0), (1, 0, 0), (0, 0, 1), diffuse(0.5, 1.0))]
    settings = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=64, max_bounces=4)
    down = np.broadcast_to(np.array([0.0, -1.0, 0.0]), (256, 3))
    hits = ls.trace_rays(ls.Scene(meshes=room), np.full((256, 3), 0.5), down, settings, device="cpu")
    view = ls.Camera.look_at((0.5, 0.5, 0.5), (0.5, 0.0, 0.5), (0, 0, 1), width=16, height=16, fov_y=0.01)
    frame = paths(ls.Scene(meshes=room), view, 64, 4)
    assert hits.color_space == "linear"
    np.testing.assert_allclose(hits.radiance.mean(), frame.color.mean(), rtol=0.02)


def test_path_traced_ray_queries_of_unlit_scenes_equal_those_of_the_trace_pipeline() -> None:
    """Without any light, rays return the captured colours of a relit set, as in the trace pipeline."""
    unlit = ls.Scene(splats=[as_splats(ball(0.3, diffuse(0.7), rows=16), 500)])
    directions = np.array([[0.0, 0.0, 1.0], [0.05, 0.02, 1.0]])
    seen = [
        ls.trace_rays(unlit, (0.0, 0.0, -1.0), directions, ls.RenderConfig(pipeline=pipeline), device="cpu").radiance
        for pipeline in (ls.Pipeline.PATH, ls.Pipeline.TRACE)
    ]
    np.testing.assert_array_equal(seen[0], seen[1])


@pytest.mark.parametrize("kind", ["rect", "emitter"])
def test_absorbing_medium_attenuates_light_paths_and_camera_paths(kind: str) -> None:
    """The floor, a light one unit above it and the camera's path lie in a medium that absorbs half per unit."""
    water = ls.MaterialPbr(
        base_color=(1, 1, 1), transmission=1.0, roughness=0.0, ior=1.0, specular=0.0, attenuation_color=(0.5,) * 3
    )
    source = ls.LightRect((0, 1, 0), (0.2, 0, 0), (0, 0, 0.2), intensity=20.0)
    emitter = quad((-0.1, 1, -0.1), (0.2, 0, 0), (0, 0, 0.2), diffuse(0.0, 20.0))
    floor = quad((-3, 0, -3), (0, 0, 6), (6, 0, 0), diffuse(0.5))
    above = ls.Camera.look_at((0.9, 5.0, 0.0), (0.9, 0.0, 0.0), (0, 0, 1), width=16, height=16, fov_y=0.004)
    means: list[float] = []
    for distance in (np.inf, 1.0):
        body = ls.MeshInstance(replace(ls.box((8, 4, 8)), material=replace(water, attenuation_distance=distance)))
        meshes = [body, floor] if kind == "rect" else [body, floor, emitter]
        lights = [source] if kind == "rect" else []
        means.append(float(paths(ls.Scene(meshes=meshes, lights=lights), above, 64, 3).color.mean()))
    path_length = 2.0 + np.hypot(1.0, 0.9)
    assert means[0] > 0.0
    np.testing.assert_allclose(means[1] / means[0], 0.5**path_length, rtol=0.04)
