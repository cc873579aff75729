"""Camera rays hit the Gaussians listed for their tile exactly as those that they find in BVHs."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer.raster import binning
from support.compare.backends import renderer_of
from support.compare.images import assert_close
from support.scenes.lenses import LENSES, large, layers, needle
from support.scenes.raster_scenes import front_camera, octahedron, quad, random_gaussians, similarity

BACKENDS = ("cpu", "cpu as cuda")
IMAGES = ("color", "alpha", "depth", "normal", "gaussian_index", "instance_index")
DISTANCES = list(ls.config.HitDistance)


def settings(strategy: ls.config.TraceStrategy = ls.config.TraceStrategy.SORTED, **changes: object) -> ls.RenderConfig:
    """Returns settings of unlit traced frames; ``changes`` are fields of ``TraceConfig``."""
    trace = replace(ls.TraceConfig(strategy=strategy), **changes)
    return ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False, trace=trace, seed=3, aovs=("hits",))


@functools.cache
def renderer(backend: str, config: ls.RenderConfig, *, lists: bool) -> ls.Renderer:
    """Returns a renderer whose camera rays use lists by tiles, or BVHs."""
    return renderer_of(backend, config, lists=lists)


def assert_lists_equal_bvhs(
    config: ls.RenderConfig, scene: ls.Scene, camera: ls.Camera, backend: str = "cpu", names: tuple[str, ...] = IMAGES
) -> ls.Frame:
    """Asserts that frames by lists and by BVHs differ at most by rounding; returns the frame by lists."""
    listed, traversed = (renderer(backend, config, lists=lists).render(scene, camera) for lists in (True, False))
    assert renderer(backend, config, lists=True)._lists is not None
    for name in names:
        assert_close(getattr(listed, name), getattr(traversed, name), atol=4e-6, name=name)
    if "hits" in config.aovs:
        np.testing.assert_array_equal(listed.hits, traversed.hits)
    assert listed.alpha.max() > 0.3
    return listed


def around_the_eye() -> ls.Gaussians:
    """Returns Gaussians of all sizes, needles and discs among them, in all directions and around the eye."""
    gaussians = random_gaussians(7, 700, degree=1, center=(0.0, 0.0, 0.0), extent=(3.0, 3.0, 3.0))
    scales = np.exp(np.random.default_rng(7).uniform(np.log(0.003), np.log(1.5), (700, 3)))
    return replace(gaussians, scales=scales, opacities=np.random.default_rng(8).uniform(0.02, 0.4, 700))


def placed() -> ls.Scene:
    """Returns two instances of one set, one of another kernel, a mesh among them and a mesh behind them."""
    asset = random_gaussians(70, 120, degree=2, center=(0.0, 0.0, 0.0), extent=(1.0, 1.0, 1.0))
    other = replace(random_gaussians(71, 60, degree=0), kernel_degree=3)
    splats = [ls.SplatInstance(asset, similarity((1, 1, 0), 0.4 + i, 0.8, (i - 0.5, 0.2 * i, 4.0))) for i in range(2)]
    return ls.Scene([*splats, ls.SplatInstance(other)], [octahedron((0.1, 0.1, 4.0), 0.6), quad(5.5, tilt=0.3)])


MOVING = similarity((0.0, 1.0, 0.0), 0.1, 1.0, (0.3, 0.0, 0.1))
VIEWS = {
    "pinhole": front_camera(37, 26, 30.0),
    "window": replace(front_camera(48, 40, 30.0), window=(16, 16, 32, 24)),
    "wide": front_camera(26, 22, 5.0),
    "near": front_camera(30, 24, 25.0, near=0.9),
    "near fisheye": front_camera(30, 24, 14.0, near=0.9, model=ls.CameraModel.FISHEYE),
    "narrow": front_camera(26, 22, 900.0),
    "fisheye": front_camera(30, 30, 30 / np.radians(220.0), model=ls.CameraModel.FISHEYE),
    "shutter": front_camera(30, 24, 25.0, camera_from_world_end=MOVING),
}


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_lists_by_tiles_and_bvhs_give_the_same_hits_in_the_same_order(backend: str, name: str) -> None:
    """For each order of hits and strategy, with Gaussians around the eye and across the image's edge."""
    for scene in (ls.Scene([around_the_eye()]), placed()):
        for strategy in ls.config.TraceStrategy:
            for distance in DISTANCES:
                config = settings(strategy, hit_distance=distance)
                assert_lists_equal_bvhs(config, scene, VIEWS[name], backend)


@pytest.mark.parametrize("name", LENSES)
def test_no_lens_loses_hits_of_large_gaussians_or_needles_at_the_borders_of_tiles(name: str) -> None:
    """Distortion, folds, fields of 360 degrees and rolling shutters, with the footprints of coarse images."""
    camera = LENSES[name]
    for seed in (1, 2):
        scene = ls.Scene([layers(camera, seed), large(seed), needle(seed, camera)])
        assert_lists_equal_bvhs(settings(dilation=2.0), scene, camera)


def test_lists_are_long_enough_for_more_hits_than_a_ray_buffers() -> None:
    """Rays that hit hundreds of Gaussians at nearly one distance need several passes over their list."""
    gaussians = random_gaussians(3, 600, 0, (0.0, 0.0, 4.0), (0.3, 0.3, 1e-4), scale_range=(0.5, 0.9))
    scene = ls.Scene([replace(gaussians, opacities=np.full(600, 0.012))])
    for backend in BACKENDS:
        for distance in DISTANCES:
            frame = assert_lists_equal_bvhs(settings(hit_distance=distance), scene, front_camera(12, 12, 30.0), backend)
            assert frame.hits is not None and frame.hits.max() > 2 * 64


@pytest.mark.parametrize("method", list(ls.config.NormalMethod))
def test_normals_that_depend_on_the_ray_are_those_of_bvhs(method: ls.config.NormalMethod) -> None:
    """Colours and normals of the eye are computed once a frame; those of ellipsoids and stored ones, per ray."""
    stored = replace(around_the_eye(), normals=np.tile([0.6, 0.0, 0.8], (700, 1)))
    lit = replace(settings(normal_method=method), lighting=True, aovs=())
    scene = ls.Scene([ls.SplatInstance(stored, material=ls.MaterialPbr())], lights=[ls.LightPoint((0.0, 1.0, 0.0))])
    for config, shown in ((settings(normal_method=method), placed()), (lit, scene)):
        assert_lists_equal_bvhs(config, shown, VIEWS["pinhole"])


@pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.PATH])
def test_jittered_samples_of_lit_frames_are_those_of_bvhs(pipeline: ls.Pipeline) -> None:
    """Lists hold for all samples of a pixel, for relit and emissive sets, which paths hit in different ways."""
    captured, relit = random_gaussians(5, 150, degree=1), random_gaussians(6, 150, degree=0)
    light = ls.LightPoint((0.0, -2.0, 0.0), intensity=40.0)
    splats = [ls.SplatInstance(captured), ls.SplatInstance(relit, material=ls.MaterialPbr())]
    config = ls.RenderConfig(pipeline=pipeline, samples=5, seed=2, jitter=True, max_bounces=1)
    for chosen in (splats, splats[:1], splats[1:]):
        scene = ls.Scene(chosen, [quad(6.0)], lights=[light])
        assert_lists_equal_bvhs(config, scene, VIEWS["pinhole"], names=("color", "alpha"))


def test_bvhs_are_built_only_for_rays_that_traverse_them() -> None:
    """An unlit traced or hybrid frame builds none; mirrors, shadows, apertures and parallel rays need them."""
    scene, mirror = ls.Scene([around_the_eye()]), quad(5.0, material=ls.MaterialPbr(metallic=1.0, roughness=0.0))
    camera = VIEWS["pinhole"]

    def builds(config: ls.RenderConfig, shown: ls.Scene, seen_by: ls.Camera = camera) -> bool:
        fresh = ls.create_renderer(config, "cpu", compiles=False)
        fresh.render(shown, seen_by)
        return fresh._scene.bvh.assets is not None

    traced = settings()
    assert not builds(traced, scene)
    assert not builds(replace(traced, pipeline=ls.Pipeline.HYBRID, aovs=()), scene)
    assert builds(traced, ls.Scene(scene.splats, [mirror]))
    assert builds(traced, scene, replace(camera, aperture=0.1, focus_distance=3.0))
    assert builds(traced, scene, replace(camera, model=ls.CameraModel.ORTHOGRAPHIC))
    lit = ls.Scene([ls.SplatInstance(around_the_eye(), material=ls.MaterialPbr())], lights=[ls.LightPoint((0, 2, 0))])
    assert builds(replace(traced, lighting=True, aovs=()), lit)


@pytest.mark.parametrize("backend", BACKENDS)
def test_rays_traverse_bvhs_if_the_lists_of_tiles_would_be_too_long(
    monkeypatch: pytest.MonkeyPatch, backend: str
) -> None:
    """The frame is the one with lists, and later frames have lists again."""
    fresh, scene, view = renderer_of(backend, settings()), ls.Scene([around_the_eye()]), VIEWS["pinhole"]
    expected = fresh.render(scene, view)
    with monkeypatch.context() as patched:
        patched.setattr(binning, "ITEMS_MAX", 100)
        frame = fresh.render(scene, view)
        assert fresh._lists is None
    assert_close(frame.color, expected.color, atol=4e-6)
    fresh.render(scene, view)
    assert fresh._lists is not None


def test_scenes_of_many_instances_need_no_memory_for_each_instance_of_a_gaussian() -> None:
    """Five instances of one set traverse its BVH; four are listed by tiles."""
    asset, fresh = random_gaussians(70, 120), ls.create_renderer(settings(), "cpu")
    for count in (4, 5):
        splats = [ls.SplatInstance(asset, similarity((0, 1, 0), 0.1 * i, 1.0, (0.1 * i, 0, 0))) for i in range(count)]
        fresh.render(ls.Scene(splats), VIEWS["pinhole"])
        assert (fresh._lists is not None) == (count == 4)
