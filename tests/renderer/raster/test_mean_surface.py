"""Weighted-mean surface of a pixel's Gaussians: float64 twin, closed forms, and frames without such a surface."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import lumisplat as ls
from lumisplat.device.gi.surfaces import SurfacePixels
from lumisplat.renderer.realtime.gbuffer import SPLATS
from support.compare.backends import renderer_of
from support.compare.images import assert_close, assert_close_outside_band
from support.oracles import mean_surface_oracle as oracle, raster_oracle
from support.scenes.path_rooms import PathRoom, path_rooms, room_camera, with_gaussians
from support.scenes.raster_scenes import (
    flat_sh,
    front_camera,
    joined,
    one_gaussian,
    quad,
    random_gaussians,
    rotation,
    similarity,
)

Doubles = npt.NDArray[np.float64]

MEAN = ls.RasterConfig(surface=ls.config.GaussianSurface.MEAN)
LIGHT = ls.LightDirectional((0.2, 0.1, 1.0), intensity=3.0)
MATTE = ls.MaterialPbr(specular=0.0)
CENTRE = (24, 32)


def surfaces(
    scene: ls.Scene, camera: ls.Camera, raster: ls.RasterConfig = MEAN, backend: str = "cpu"
) -> dict[str, Doubles]:
    """Returns the mean surface of each pixel in a real-time frame's G-buffer, and ``depth_z``; 0 without Gaussians."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, raster=raster, max_bounces=0, jitter=False)
    renderer = renderer_of(backend, config)
    frames = 4 if backend == "cpu as graph" else 1  # the third frame captures a graph, and the fourth replays it
    for _ in range(frames):
        ls.Renderer.render(renderer, scene, camera)
    count = camera.height * camera.width
    pixels: Any = renderer._buffers.struct(f"gbuffer.{SPLATS}.{(frames - 1) % 2}", SurfacePixels, count)
    seen = pixels.share.numpy() > 0.0
    found = {}
    for name in ("share", "distance", "position", "alpha", "albedo"):
        values = getattr(pixels, name).numpy().copy()
        values[~seen] = 0.0
        found[name] = values.reshape(camera.height, camera.width, *values.shape[1:]).astype(np.float64)
    found["depth_z"] = found["distance"] / np.linalg.norm(raster_oracle.pixel_rays(camera), axis=-1)
    return found


def relit(*sets: ls.Gaussians, **settings: Any) -> ls.Scene:
    """Returns a scene of sets with a material that reflects light."""
    return ls.Scene([ls.SplatInstance(gaussians, material=MATTE, **settings) for gaussians in sets], lights=[LIGHT])


def veil(depth: float, opacity: float, **changes: Any) -> ls.Gaussians:
    """Returns one flat Gaussian, so wide that its alpha is constant over the view."""
    return one_gaussian((0.0, 0.0, depth), (60.0, 60.0, 0.001), opacity, **changes)


def of_many_kinds() -> tuple[ls.Scene, list[Doubles]]:
    """Returns two relit sets, one of them transformed, an emissive capture and a mesh, and the sets' roughnesses."""
    rough = [np.random.default_rng(seed).uniform(0.2, 1.0, 120).astype(np.float32) for seed in range(2)]
    first = random_gaussians(21, 120, roughness=rough[0])
    second = random_gaussians(22, 120, center=(0.0, 0.0, 0.0), extent=(1.2, 1.0, 0.8), roughness=rough[1])
    transform = similarity((1.0, 2.0, 0.5), 1.1, 1.3, (0.3, 0.1, 4.4))
    sets = [
        ls.SplatInstance(first, material=MATTE),
        ls.SplatInstance(random_gaussians(23, 50)),
        ls.SplatInstance(second, transform, material=MATTE),
    ]
    values = [rough[0][:, None], np.zeros((50, 1)), rough[1][:, None]]
    return ls.Scene(sets, [quad(4.6, 0.9, 0.3)], [LIGHT]), [np.asarray(value, np.float64) for value in values]


@pytest.mark.parametrize("dilation", [0.3, 3.0])
def test_mean_surface_of_gaussians_equals_the_float64_reference(backend: str, dilation: float) -> None:
    """Depth, weight and roughness are compared in each pixel, for relit sets among emissive ones and before a mesh."""
    scene, rough = of_many_kinds()
    camera, raster = front_camera(), replace(MEAN, dilation=dilation)
    found = surfaces(scene, camera, raster, backend)
    twin = oracle.mean_surface(scene, camera, raster, (0, 2), rough)
    by_peaks = ls.config.TraceConfig(hit_distance=ls.config.HitDistance.PEAK)
    band = raster_oracle.render(scene, camera, ls.RenderConfig(raster=raster, trace=by_peaks))["band"]
    seen = twin.share > 0.0
    assert seen.mean() > 0.8
    depth_z = np.minimum(twin.depth_z, raster_oracle.rasterize_meshes(scene, camera).depth_z)
    for name, expected in (("share", twin.share), ("depth_z", depth_z)):
        actual = np.where(seen, found[name], expected)
        assert_close_outside_band(actual, expected, band, atol=5e-5 * 5.0, band_share=0.4, name=name)
    roughness = np.where(seen, np.sqrt(found["alpha"]), twin.values[..., 0])
    assert_close_outside_band(roughness, twin.values[..., 0], band, atol=1e-4, band_share=0.4, name="roughness")


def test_mean_surface_of_two_layers_has_depth_and_material_weighted_by_blend_weights(backend: str) -> None:
    """With weights of 0.5 and 0.5 x 0.6, the test compares depth, roughness, metallic and albedo."""
    near = veil(3.0, 0.5, roughness=[0.2], metallic=[0.0])
    far = veil(5.0, 0.6, roughness=[0.8], metallic=[1.0])
    found = surfaces(relit(near, far), front_camera(), backend=backend)
    weights = np.array([0.5, 0.3])
    assert found["share"][CENTRE] == pytest.approx(0.8, rel=1e-3)
    assert_close(found["depth_z"], np.full((48, 64), weights @ [3.0, 5.0] / 0.8), atol=0.01)
    assert found["depth_z"][CENTRE] == pytest.approx(weights @ [3.0, 5.0] / 0.8, rel=1e-4)
    assert np.sqrt(found["alpha"][CENTRE]) == pytest.approx(weights @ [0.2, 0.8] / 0.8, rel=1e-4)
    plain = surfaces(
        relit(veil(3.0, 0.5, metallic=[0.0]), veil(5.0, 0.6, metallic=[0.0])), front_camera(), backend=backend
    )
    np.testing.assert_allclose(found["albedo"][CENTRE], (1.0 - 0.3 / 0.8) * plain["albedo"][CENTRE], rtol=1e-3)


def test_gaussians_too_transparent_for_an_iso_surface_have_a_mean_surface() -> None:
    """The positions of the mean surface lie on the rays."""
    camera = front_camera()
    found = surfaces(relit(veil(3.0, 0.1), veil(5.0, 0.1)), camera)
    ray = raster_oracle.pixel_rays(camera)
    assert found["depth_z"][CENTRE] == pytest.approx((0.1 * 3.0 + 0.09 * 5.0) / 0.19, rel=1e-3)
    assert_close(found["position"], found["depth_z"][..., None] * ray, atol=1e-4)


@pytest.mark.parametrize("tilt", [0.3, 1.0])
def test_mean_surface_depth_near_a_gaussians_mean_is_where_its_response_peaks_on_the_ray(tilt: float) -> None:
    """Without dilation, the depth of a splat near its mean is that of the Gaussian's peak response on the ray."""
    half = 0.5 * tilt
    gaussian = one_gaussian(
        (0.4, -0.3, 4.0), (0.5, 0.3, 0.02), rotation=(np.cos(half), 0.6 * np.sin(half), 0.8 * np.sin(half), 0.0)
    )
    scene, camera, raster = relit(gaussian), front_camera(400, 300, 400.0), replace(MEAN, dilation=0.0)
    splats = raster_oracle.project(scene, camera, raster)
    exact = raster_oracle.peak_depth(splats, 0, camera)
    found = surfaces(scene, camera, raster)["depth_z"]
    column, row = np.floor(splats.mean_px[0]).astype(int)
    near = np.s_[row - 4 : row + 5, column - 4 : column + 5]
    assert np.ptp(exact[near]) > 0.01
    assert_close(found[near], exact[near], atol=0.02 * np.ptp(exact[near]))


def tilted_wall(angle: float) -> ls.Gaussians:
    """Returns a wall of flat Gaussians, rotated about the x axis."""
    x, y = np.meshgrid(np.arange(-4.0, 4.0, 0.25), np.arange(-4.0, 4.0, 0.25))
    rotation_matrix = rotation((1.0, 0.0, 0.0), angle)[:3, :3]
    means = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3) @ rotation_matrix.T + [0.0, 0.0, 6.0]
    count = len(means)
    turned = np.tile([np.cos(0.5 * angle), np.sin(0.5 * angle), 0.0, 0.0], (count, 1))
    return ls.Gaussians(
        means, turned, np.tile([0.25, 0.25, 0.001], (count, 1)), np.full(count, 0.6), flat_sh(np.full((count, 3), 0.6))
    )


def test_mean_surface_of_a_tilted_wall_of_gaussians_is_planar() -> None:
    """Depths that vary linearly over each splat reproduce the wall; the means' depths would lie far in front of it."""
    angle, camera = 0.9, front_camera(focal=120.0)
    scene = relit(tilted_wall(angle))
    normal = np.array([0.0, -np.sin(angle), np.cos(angle)])
    plane = 6.0 * normal[2] / (raster_oracle.pixel_rays(camera) @ normal)
    middle = np.s_[12:36, 16:48]
    error = np.abs(surfaces(scene, camera)["depth_z"] - plane)[middle]
    of_means = np.abs(oracle.mean_surface(scene, camera, MEAN, (0,), linear=False).depth_z - plane)[middle]
    assert error.max() < 0.02
    assert error.mean() < 0.1 * of_means.mean()


def test_mean_surface_is_not_behind_the_mesh_that_the_splat_covers() -> None:
    """Where a splat covers a mesh but is deeper at the pixel, the depth of the surface is the mesh's."""
    half = 0.6
    tilted = one_gaussian((0.0, 0.0, 4.0), (2.0, 2.0, 0.01), 0.9, rotation=(np.cos(half), np.sin(half), 0.0, 0.0))
    scene = replace(relit(tilted), meshes=[quad(4.2, 9.0)])
    depth_z = surfaces(scene, front_camera())["depth_z"]
    assert depth_z.max() == pytest.approx(4.2, rel=1e-5)
    assert (depth_z < 4.19).any()


KEPT = ls.SplatInstance(random_gaussians(5), material=ls.MaterialSimple(ambient=(0.4, 0.4, 0.4)))
UNCHANGED = {
    "unlit": (ls.Scene([random_gaussians(5)]), ls.RenderConfig()),
    "captured": (ls.Scene([KEPT], lights=[LIGHT]), ls.RenderConfig()),
    "traced": (relit(random_gaussians(5)), ls.RenderConfig(pipeline=ls.Pipeline.TRACE)),
    "stochastic": (
        relit(random_gaussians(5)),
        ls.RenderConfig(raster=ls.RasterConfig(strategy=ls.config.RasterStrategy.STOCHASTIC), samples=2),
    ),
}


@pytest.mark.parametrize("kind", UNCHANGED)
def test_choice_of_mean_or_iso_surface_does_not_change_frames_without_lit_gaussians(kind: str) -> None:
    """The bits are equal in unlit frames, emissive captures, traced frames and stochastic samples."""
    scene, config = UNCHANGED[kind]
    mean = replace(config, raster=replace(config.raster, surface=ls.config.GaussianSurface.MEAN))
    iso, other = (ls.render(scene, front_camera(), settings, device="cpu") for settings in (config, mean))
    np.testing.assert_array_equal(iso.color, other.color)
    np.testing.assert_array_equal(iso.depth, other.depth)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.HYBRID])
def test_light_on_a_mean_surface_falls_off_with_the_squared_distance_from_the_light(pipeline: ls.Pipeline) -> None:
    """Light from the eye falls off with the square of the mean distance, not of the distance of the nearer layer."""
    light = ls.LightPoint((0.0, 0.0, 0.0), intensity=30.0, casts_shadow=False)
    veils = joined(veil(3.0, 0.5), veil(5.0, 0.6))
    scene, alone = replace(relit(veils), lights=[light]), replace(relit(veil(4.0, 0.8)), lights=[light])
    config = ls.RenderConfig(pipeline=pipeline, raster=MEAN)
    found, expected = (ls.render(content, front_camera(), config, device="cpu").color for content in (scene, alone))
    ratio = found[CENTRE] / expected[CENTRE]
    np.testing.assert_allclose(ratio, (4.0 / 3.75) ** 2, rtol=2e-3)


def test_realtime_frames_of_opaque_rooms_are_equally_bright_with_mean_and_iso_surfaces() -> None:
    """The frames agree within a few per cent."""
    view = room_camera(96, 72)
    scene = with_gaussians(PathRoom(path_rooms()["diffuse_area"].scene, view), 4000).scene
    means = []
    for raster in (ls.RasterConfig(), MEAN):
        renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, raster=raster), "cpu")
        frames = [renderer.render(scene, view).color for _ in range(12)]
        means.append(np.mean(frames[4:], axis=0))
    assert means[1].mean() == pytest.approx(means[0].mean(), rel=0.03)
    blocks = [mean.reshape(6, 12, 8, 12, 3).mean(axis=(1, 3, 4)) for mean in means]
    assert np.percentile(np.abs(blocks[1] / blocks[0] - 1.0), 90) < 0.05
