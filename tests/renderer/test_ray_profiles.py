"""Lists of the Gaussians on rays, compared with the float64 twin, and cameras focused on a pixel's surface."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer import rays as rays_module
from support.oracles.mirror_oracle import ROUNDING, Ray, nearest
from support.oracles.particle_oracle import picked, world_of
from support.oracles.raster_oracle import normalized
from support.oracles.trace_oracle import blend, hits_before
from support.scenes.raster_scenes import front_camera, one_gaussian, quad, random_gaussians, similarity

PLACED = ls.SplatInstance(random_gaussians(3, count=80), similarity((1.0, 2.0, 0.5), 0.4, 0.9, (0.1, 0.2, 0.3)))
MIXED = ls.Scene([random_gaussians(2, count=150), PLACED], [quad(4.6, tilt=0.3)])


def some_rays(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Returns rays from around the origin to around the scenes."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(scale=0.2, size=(count, 3))
    return origins, rng.normal((0.0, 0.0, 4.0), (1.0, 0.7, 0.3), (count, 3)) - origins


def profiled(scene: ls.Scene, origins: np.ndarray, directions: np.ndarray, **trace: Any) -> ls.rays.RayProfile:
    """Returns the profile of rays, with settings of the tracer."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, trace=ls.TraceConfig(**trace))
    profile = ls.trace_rays(scene, origins, directions, config, profile=True, device="cpu").profile
    assert profile is not None
    return profile


@pytest.mark.parametrize("order", ["peak", "mean", "hull"])
def test_lists_of_gaussians_along_queried_rays_equal_the_float64_reference(order: str) -> None:
    """Index, distance, alpha and transmittance of each Gaussian are equal up to float32 rounding."""
    origins, directions = some_rays(150)
    profile = profiled(MIXED, origins, directions, hit_distance=order)
    world = world_of(MIXED, ls.RenderConfig(trace=ls.TraceConfig(hit_distance=ls.config.HitDistance(order))))
    compared = 0
    for ray, (origin, direction) in enumerate(zip(origins, normalized(directions), strict=True)):
        twin = Ray(origin, direction, blur=ROUNDING * np.abs(origin).max())
        every = hits_before(world, twin, nearest(world.triangles, twin))
        found = picked(every, every.counts)
        left = blend(found, 0.7).after
        if every.doubtful.any() or (left < 2e-4).any() or (np.diff(found.t) < 1e-4).any():
            continue
        compared += len(found) > 2
        rows = profile.rows(ray)
        np.testing.assert_array_equal(profile.gaussian_index[rows], world.gaussian[found.index])
        np.testing.assert_array_equal(profile.instance_index[rows], world.instance[found.index])
        np.testing.assert_allclose(profile.t[rows], found.t, atol=1e-4)
        np.testing.assert_allclose(profile.alpha[rows], found.alpha, atol=1e-4)
        np.testing.assert_allclose(profile.transmittance[rows], left, atol=1e-4)
    assert compared > 50


def test_transmittances_of_a_ray_profile_are_products_of_its_alphas() -> None:
    """Distances ascend, and the last transmittance is that of the ray without a mesh."""
    scene = ls.Scene([random_gaussians(4, count=500)])
    origins, directions = some_rays(400)
    hits = ls.trace_rays(scene, origins, directions, profile=True, device="cpu")
    profile = hits.profile
    assert profile is not None and len(profile) == 400 and profile.first[-1] == len(profile.t)
    assert np.diff(profile.first).max() > 10
    for ray in range(400):
        rows = profile.rows(ray)
        assert (np.diff(profile.t[rows]) >= 0.0).all()
        product = np.cumprod(1.0 - profile.alpha[rows].astype(np.float64))
        np.testing.assert_allclose(profile.transmittance[rows], product, rtol=1e-4)
        assert hits.transmittance[ray] == pytest.approx(product[-1] if len(product) else 1.0, rel=1e-4, abs=1e-7)


def test_ray_profiles_do_not_depend_on_the_trace_strategy() -> None:
    """Stochastic strategies and path tracing give the profiles of the sorted strategy."""
    origins, directions = some_rays(50)
    exact = profiled(MIXED, origins, directions)
    for strategy in ("stochastic-hit", "stochastic-pass"):
        other = profiled(MIXED, origins, directions, strategy=strategy)
        np.testing.assert_array_equal(other.alpha, exact.alpha)
    path = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=1, lighting=False)
    of_paths = ls.trace_rays(MIXED, origins, directions, path, profile=True, device="cpu").profile
    assert of_paths is not None
    np.testing.assert_array_equal(of_paths.gaussian_index, exact.gaussian_index)


def test_ray_profiles_do_not_depend_on_the_size_of_the_hit_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The profiles are equal even if one ray has more hits than the buffer."""
    origins, directions = some_rays(60)
    whole = profiled(MIXED, origins, directions)
    monkeypatch.setattr(rays_module, "PROFILE_ROWS", 5)
    monkeypatch.setattr(rays_module, "RAY_BATCH", 16)
    parts = profiled(MIXED, origins, directions)
    for name in ("first", "t", "alpha", "transmittance", "gaussian_index", "instance_index"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))


def test_ray_profiles_are_computed_in_ranges_of_rays_within_the_limit_of_hits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ranges cover all rays with hits once; a range exceeds the limit only if it cannot be split."""
    monkeypatch.setattr(rays_module, "PROFILE_ROWS", 400)
    monkeypatch.setattr(rays_module, "RAY_BATCH", 96)
    counts = np.random.default_rng(0).integers(0, 14, 1000, np.int32)
    counts[64:128], counts[200:220] = 0, 100
    ranges = list(rays_module.profile_ranges(counts))
    visits = np.zeros(1000, int)
    for begin, end in ranges:
        visits[begin:end] += 1
        assert begin % 32 == 0 and end - begin <= 96
        assert counts[begin:end].sum() <= 400 or end - begin == 32
    assert (visits[counts > 0] == 1).all() and visits.max() == 1
    assert list(rays_module.profile_ranges(np.zeros(5, np.int32))) == [(0, 0)]


def test_rays_without_hits_have_empty_profiles() -> None:
    """The scene is empty, the rays miss a Gaussian, or there are no rays."""
    away = np.array([[0.0, 1.0, 0.0]])
    for scene in (ls.Scene(), ls.Scene([one_gaussian()]), ls.Scene([], [quad(3.0)])):
        assert profiled(scene, np.zeros((1, 3)), away).first.tolist() == [0, 0]
    none = profiled(ls.Scene([one_gaussian()]), np.zeros((0, 3)), np.zeros((0, 3)))
    assert len(none) == 0 and none.t.shape == (0,)
    assert repr(none) == "RayProfile(rays=0, hits=0)"


def test_ray_queries_return_no_profiles_unless_the_caller_asks_for_them() -> None:
    """Without ``profile``, the result has no profile."""
    assert ls.trace_rays(ls.Scene([one_gaussian()]), (0, 0, 0), [[0.0, 0.0, 1.0]], device="cpu").profile is None


CAMERAS = {
    "pinhole": front_camera(),
    "fisheye": front_camera(model=ls.CameraModel.FISHEYE),
    "orthographic": front_camera(model=ls.CameraModel.ORTHOGRAPHIC, fx=15.0, fy=15.0),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_camera_can_be_focused_on_the_surface_at_a_pixel(name: str) -> None:
    """On Gaussians and meshes, the focus distance is the frame's view depth, or the distance for a fisheye."""
    scene, camera = ls.Scene([one_gaussian((-0.6, 0.0, 3.0), opacity=0.9)], [quad(4.0, tilt=0.2)]), CAMERAS[name]
    frame = ls.render(scene, camera, ls.RenderConfig(pipeline=ls.Pipeline.TRACE), device="cpu")
    depth = frame.depth if name == "fisheye" else frame.depth_z
    seen = set()
    for y, x in np.argwhere(np.isfinite(frame.depth))[::61]:
        focused = ls.rays.focused(scene, replace(camera, aperture=0.05), int(x), int(y), device="cpu")
        assert focused.focus_distance == pytest.approx(depth[y, x], rel=1e-3)
        assert focused.aperture == 0.05
        seen.add(int(frame.instance_index[y, x]))
    assert seen == {0, 1}


def test_surface_on_which_a_camera_is_focused_is_sharp_and_others_are_blurred() -> None:
    """The aperture is wide; nearer objects are blurred."""
    rng = np.random.default_rng(2)
    texture = rng.integers(0, 2, (16, 16, 3), np.uint8) * 255
    uvs = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    near, far = (
        quad(z, half=0.3 * z, uvs=uvs, material=ls.MaterialPbr(base_color_texture=texture)) for z in (3.0, 9.0)
    )
    moved = [ls.MeshInstance(mesh, similarity(offset=(x, 0.0, 0.0))) for mesh, x in ((near, -0.9), (far, 2.7))]
    scene, camera = ls.Scene([], moved), front_camera(aperture=0.4, focus_distance=3.0)
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=16, lighting=False)
    contrast = {}
    for name, x in (("near", 14), ("far", 50)):
        frame = ls.render(scene, ls.rays.focused(scene, camera, x, 24, device="cpu"), config, device="cpu")
        contrast[name] = [frame.color[15:33, first : first + 18].std() for first in (5, 41)]
    assert contrast["near"][0] > 1.3 * contrast["far"][0]
    assert contrast["far"][1] > 1.3 * contrast["near"][1]


@pytest.mark.parametrize(
    ("pixel", "message"),
    [
        ((64, 0), "pixel x is 64, expected a whole number from 0 to 63"),
        ((0, -1), "pixel y is -1, expected a whole number from 0 to 47"),
        ((1.5, 0), r"pixel x is 1\.5"),
        ((0, 0), r"pixel \(0, 0\) shows no surface to focus on"),
    ],
)
def test_focusing_on_a_pixel_outside_the_image_or_without_a_surface_is_refused(
    pixel: tuple[Any, Any], message: str
) -> None:
    """Focusing on such a pixel raises an error."""
    with pytest.raises(ls.SceneError, match=message):
        ls.rays.focused(ls.Scene([one_gaussian()]), front_camera(), *pixel, device="cpu")


def test_renderer_of_the_raster_pipeline_refuses_to_focus_a_camera() -> None:
    """Rasterised frames have no lens to focus."""
    with pytest.raises(ls.ConfigError, match="this one rasterises"):
        ls.create_renderer(device="cpu").focused(ls.Scene([one_gaussian()]), front_camera(), 32, 24)
