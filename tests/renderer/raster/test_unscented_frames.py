"""Frames rasterised along rays by unscented projection, against the tracer, the float64 twin and linear projection."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.runtime.launcher import Launcher
from support.compare.backends import BACKENDS, renderer_of
from support.oracles.unscented_oracle import Parameters, Twin
from support.scenes.lenses import FISHEYE, LENSES, large, layers, lens, needle, rolling
from support.scenes.raster_scenes import checker_quad, random_gaussians

NAMES = list(LENSES)


def unscented(**changes: object) -> ls.RenderConfig:
    """Returns settings with the unscented projection; ``changes`` are fields of ``RasterConfig``."""
    return ls.RenderConfig(raster=replace(ls.RasterConfig(projection=ls.config.Projection.UNSCENTED), **changes))


def traced(dilation: float = 0.3) -> ls.RenderConfig:
    """Returns settings of the traced frames for comparison."""
    trace = ls.TraceConfig(dilation=dilation, hit_distance=ls.config.HitDistance.MEAN)
    return ls.RenderConfig(pipeline=ls.Pipeline.TRACE, trace=trace)


@pytest.mark.parametrize("name", NAMES)
def test_unscented_frame_equals_the_ray_traced_frame_for_every_lens(name: str) -> None:
    """Where no Gaussians change their order, colour, alpha, depth, normal and index are equal."""
    camera = LENSES[name]
    scene = ls.Scene([layers(camera)])
    frame = ls.render(scene, camera, unscented(dilation=0.0), device="cpu")
    expected = ls.render(scene, camera, traced(0.0), device="cpu")
    assert expected.alpha.mean() > 0.02
    # With a rolling shutter, the rasteriser evaluates SH once per Gaussian, the tracer from the eye of each ray.
    slack = 4e-3 if camera.camera_from_world_end is not None else 0.0
    np.testing.assert_allclose(frame.alpha, expected.alpha, atol=1.5e-4)  # the tracer blends one more Gaussian
    np.testing.assert_allclose(frame.color, expected.color, atol=2e-4 + slack)
    same = frame.gaussian_index == expected.gaussian_index
    assert same.mean() > 0.999
    both = same & np.isfinite(expected.depth)
    np.testing.assert_allclose(frame.depth[both], expected.depth[both], rtol=2e-4)
    cosine = (frame.normal * expected.normal).sum(axis=-1)[frame.alpha > 0.1]
    assert np.quantile(cosine, 0.01) > 0.999 - slack


@pytest.mark.parametrize("name", NAMES)
def test_unscented_frame_of_pixel_sized_gaussians_is_close_to_the_traced_one(name: str) -> None:
    """Footprints widen such Gaussians most: they are evaluated at means here, and at each ray by the tracer."""
    camera = LENSES[name]
    camera = camera.scaled(4 * camera.width)
    gaussians = layers(camera)
    scene = ls.Scene([replace(gaussians, scales=0.1 * gaussians.scales)])
    frame = ls.render(scene, camera, unscented(), device="cpu")
    expected = ls.render(scene, camera, traced(), device="cpu")
    sharp = ls.render(scene, camera, traced(0.0), device="cpu")
    error = np.abs(frame.alpha - expected.alpha)
    assert error.max() < 1.1 / 255.0 and (error > 2e-3).mean() < 1e-3  # outlines differ in a few pixels
    assert np.abs(sharp.alpha - expected.alpha).max() > 0.3


@pytest.mark.parametrize("name", NAMES)
def test_unscented_frame_equals_the_float64_reference(name: str) -> None:
    """The twin uses double precision and no tiles; rounding may cross alpha thresholds in a few pixels."""
    camera, gaussians = LENSES[name], random_gaussians(3, count=40, degree=2, center=(0.0, 0.0, 2.0))
    config = replace(unscented(), background=(0.2, 0.4, 0.6))
    frame = ls.render(ls.Scene([gaussians]), camera, config, device="cpu")
    p = Parameters.of(gaussians, (0.2, 0.4, 0.6))
    color, transmittance = Twin(camera).sums(p)
    error = np.abs(frame.color - (color + transmittance[..., None] * p.background)).max(axis=-1)
    assert np.abs(frame.alpha - (1.0 - transmittance)).max() < 1.1 / 255.0
    assert error.max() < 1.5 / 255.0 and (error > 2e-5).mean() < 5e-3


@pytest.mark.parametrize("name", NAMES)
def test_tiles_of_unscented_frames_cut_off_no_large_gaussian_near_the_limit_of_the_lens(name: str) -> None:
    """Gaussians near the limit, behind it or around the eye have the alpha of a frame without tiles."""
    assert cut_off(LENSES[name], range(30)) > 1000


@pytest.mark.deep
@pytest.mark.parametrize("name", NAMES)
def test_tiles_of_unscented_frames_cut_off_none_of_thousands_of_large_gaussians(name: str) -> None:
    """The test draws 4,000 Gaussians per lens."""
    assert cut_off(LENSES[name], range(30, 1030)) > 30000


BACKWARD = {
    "fisheye": lens(50.0, (320, 320), model=FISHEYE),
    "rolling fisheye": rolling(lens(40.0, (256, 256), model=FISHEYE)),
}


@pytest.mark.parametrize("name", BACKWARD)
def test_tiles_of_unscented_frames_cut_off_no_gaussian_opposite_the_optical_axis(name: str) -> None:
    """Gaussians of any size and shape, one at a time, cover a ring around the image or an arc inside."""
    assert cut_off(BACKWARD[name], range(40), lambda seed: needle(seed, BACKWARD[name])) > 10000


@pytest.mark.deep
@pytest.mark.parametrize("name", BACKWARD)
def test_tiles_of_unscented_frames_cut_off_none_of_600_gaussians_opposite_the_optical_axis(name: str) -> None:
    """The test draws 600 Gaussians."""
    assert cut_off(BACKWARD[name], range(40, 640), lambda seed: needle(seed, BACKWARD[name])) > 150000


def test_tiles_of_unscented_frames_cut_off_no_gaussian_at_the_edge_of_a_wide_pinhole() -> None:
    """At 176 degrees, tangents vary strongly over a small Gaussian."""
    camera = lens(256.0 / np.tan(np.radians(88.0)), (512, 64))
    assert cut_off(camera, range(3), lambda seed: rim(seed, camera, 88.0)) > 1000


def rim(seed: int, camera: ls.Camera, degrees: float) -> ls.Gaussians:
    """Returns Gaussians of about a hundredth of a radian, within six degrees of the edge of the image."""
    rng = np.random.default_rng(seed)
    angle, turn = np.radians(rng.uniform(degrees - 6.0, degrees, 200)), rng.uniform(0.0, 2.0 * np.pi, 200)
    directions = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=-1)
    return ls.Gaussians(
        means=3.0 * directions @ camera.world_from_camera[:3, :3].T + camera.eye,
        rotations_wxyz=rng.normal(size=(200, 4)),
        scales=rng.uniform(0.012, 0.018, (200, 1)) * np.exp(rng.uniform(-2.0, 0.0, (200, 3))),
        opacities=np.full(200, 0.9),
        sh=np.zeros((200, 1, 3)),
    )


def cut_off(camera: ls.Camera, seeds: range, scene_of: Callable[[int], ls.Gaussians] = large) -> int:
    """Fails if tiles cut off parts of Gaussians; returns the number of pixels with visible Gaussians."""
    renderer = ls.create_renderer(unscented(transmittance_min=0.0, dilation=0.0), "cpu")
    camera = replace(camera, near=0.011)  # the twin lacks the default that follows the size of the scene
    twin = Twin(camera, dilation=0.0, transmittance_min=0.0)
    seen = 0
    for seed in seeds:
        gaussians = scene_of(seed)
        _, transmittance = twin.sums(Parameters.of(gaussians))
        frame = renderer.render(ls.Scene([gaussians]), camera)
        # A truncated tile loses alphas of at least 1/255; rounding at an outline may lose one in one pixel.
        difference = np.abs(frame.alpha - (1.0 - transmittance)) > 0.5 / 255.0 * transmittance
        assert difference.sum() <= 1, (seed, np.argwhere(difference))
        seen += int(np.count_nonzero(transmittance < 0.9))
    return seen


def test_unscented_projections_of_small_gaussians_converge_to_ewa_ellipses() -> None:
    """The difference is the second-order error of the linear projection, and halves with the angle of the Gaussian."""
    errors = []
    for factor in (1.0, 2.0, 4.0):
        camera = lens(60.0)
        gaussians = random_gaussians(7, count=30, scale_range=(0.02, 0.08), extent=(0.8, 0.6, 0.4))
        camera = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy, camera_from_world=np.eye(4))
        far = replace(gaussians, means=(gaussians.means - (0.0, 0.0, 4.0)) + (0.0, 0.0, 4.0 * factor))
        ewa = ls.RenderConfig(raster=ls.RasterConfig(dilation=0.0))
        frames = [ls.render(ls.Scene([far]), camera, config, device="cpu") for config in (ewa, unscented(dilation=0.0))]
        errors.append(np.abs(frames[0].alpha - frames[1].alpha).mean() / frames[0].alpha.mean())
    assert errors[0] < 0.02
    assert errors[1] < 0.6 * errors[0] and errors[2] < 0.6 * errors[1], errors


def test_point_like_gaussian_on_the_optical_axis_looks_the_same_unscented_and_as_ewa_splat() -> None:
    """A point-like Gaussian has the profile of a dilated splat."""
    camera = replace(lens(60.0), camera_from_world=np.eye(4), cx=32.0, cy=24.0, fy=60.0)
    point = ls.Gaussians([(0.0, 0.0, 4.0)], [(1.0, 0.0, 0.0, 0.0)], [(1e-4,) * 3], [0.9], np.zeros((1, 1, 3)))
    ewa, rays = (
        ls.render(ls.Scene([point]), camera, config, device="cpu") for config in (ls.RenderConfig(), unscented())
    )
    np.testing.assert_allclose(rays.alpha, ewa.alpha, atol=3e-4)
    assert ewa.alpha.max() > 0.3


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["phone", "fisheye of 220 degrees", "rolling shutter"])
def test_cpu_and_cuda_schedules_give_equal_unscented_frames(backend: str, name: str) -> None:
    """The schedules are tiles on CPUs, pixels on CUDA, and captured graphs."""
    camera, scene = LENSES[name], ls.Scene([random_gaussians(11, count=120, degree=1, center=(0.0, 0.0, 2.5))])
    frame = renderer_of(backend, unscented()).render(scene, camera)
    expected = ls.render(scene, camera, unscented(), device="cpu")
    np.testing.assert_allclose(frame.color, expected.color, atol=1e-5)
    assert (frame.gaussian_index == expected.gaussian_index).mean() > 0.999


def test_unscented_frames_do_not_depend_on_thread_count() -> None:
    """Ranges of threads write separate elements."""
    camera, scene = LENSES["rolling fisheye"], ls.Scene([random_gaussians(12, count=300, center=(0.0, 0.0, 2.5))])
    one, two, five = (ls.Renderer(unscented(), Launcher("cpu", threads)).render(scene, camera) for threads in (1, 2, 5))
    for other in (two, five):
        np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_array_equal(one.depth, other.depth)


def test_unscented_frames_of_several_samples_per_pixel_equal_ray_traced_ones() -> None:
    """Frames with several samples per pixel are compared."""
    camera, gaussians = LENSES["fisheye"], layers(LENSES["fisheye"])
    scene, samples = ls.Scene([gaussians]), 4
    frame = ls.render(scene, camera, replace(unscented(dilation=0.0), samples=samples), device="cpu")
    expected = ls.render(scene, camera, replace(traced(0.0), samples=samples), device="cpu")
    np.testing.assert_allclose(frame.color, expected.color, atol=2e-4)


def test_meshes_in_unscented_frames_equal_meshes_traced_through_the_lens() -> None:
    """A textured, lit wall between Gaussians is seen through a distorting lens."""
    camera = LENSES["fisheye of 220 degrees"]
    gaussians = layers(camera)
    scene = ls.Scene([gaussians], [checker_quad(2.5)], [ls.LightPoint((0.5, -1.0, 0.0), (1.0, 1.0, 1.0), 30.0)])
    frames = [ls.render(scene, camera, config, device="cpu") for config in (unscented(dilation=0.0), traced(0.0))]
    assert (frames[1].instance_index == 1).mean() > 0.05
    np.testing.assert_allclose(frames[0].color, frames[1].color, atol=3e-4)


def test_unscented_lit_frames_of_relit_and_emissive_captures_equal_ray_traced_ones() -> None:
    """Relit sets are accumulated separately from emissive ones."""
    camera = LENSES["phone"]
    gaussians = layers(camera, count=24)
    halves = [gaussians.subset(np.arange(k, 24, 2)) for k in (0, 1)]
    relit = ls.SplatInstance(halves[1], material=ls.MaterialPbr(roughness=0.6))
    scene = ls.Scene([ls.SplatInstance(halves[0]), relit], [], [ls.LightPoint((0.5, -1.0, 0.0), (1.0, 1.0, 1.0), 9.0)])
    frames = [
        ls.render(scene, camera, replace(config, pipeline=pipeline), device="cpu")
        for config, pipeline in ((unscented(dilation=0.0), "hybrid"), (traced(0.0), "trace"))
    ]
    np.testing.assert_allclose(frames[0].color, frames[1].color, atol=2e-3)


def test_counts_of_blended_gaussians_are_equal_in_unscented_and_ray_traced_frames() -> None:
    """The image ``hits`` counts the blended Gaussians of each pixel."""
    camera = LENSES["fisheye"]
    scene = ls.Scene([layers(camera)])
    frames = [
        ls.render(scene, camera, replace(config, aovs=("hits",)), device="cpu")
        for config in (unscented(dilation=0.0), traced(0.0))
    ]
    assert frames[0].hits is not None and frames[1].hits is not None
    assert (frames[0].hits == frames[1].hits).mean() > 0.99 and frames[0].hits.max() > 2


def test_settings_unsupported_by_the_unscented_projection_are_refused() -> None:
    """The message names the supported settings."""
    scene = ls.Scene([random_gaussians(1, count=3)])
    orthographic = lens(8.0, model=ls.CameraModel.ORTHOGRAPHIC)
    with pytest.raises(ls.SceneError, match=r"^camera is orthographic, .* use Pipeline\.TRACE$"):
        ls.render(scene, orthographic, unscented(), device="cpu")
    with pytest.raises(ls.SceneError, match=r"^camera has an aperture of 0\.1, .* use Pipeline\.TRACE$"):
        ls.render(scene, lens(40.0, aperture=0.1), unscented(), device="cpu")
    for change in ({"strategy": ls.config.RasterStrategy.STOCHASTIC}, {"surface": ls.config.GaussianSurface.MEAN}):
        with pytest.raises(ls.ConfigError, match=r"^\w+\.(STOCHASTIC|MEAN) does not work with Projection\.UNSCENTED"):
            ls.render(scene, lens(40.0), unscented(**change), device="cpu")
    with pytest.raises(ls.ConfigError, match=r"^Projection\.UNSCENTED does not work with Pipeline\.REALTIME"):
        ls.render(scene, lens(40.0), replace(unscented(), pipeline=ls.Pipeline.REALTIME), device="cpu")


def test_error_for_a_fisheye_with_ewa_suggests_the_unscented_projection() -> None:
    """The message names the setting to change."""
    with pytest.raises(ls.SceneError, match=r"use Projection\.UNSCENTED or Pipeline\.TRACE$"):
        ls.render(ls.Scene([random_gaussians(1, count=3)]), LENSES["fisheye"], device="cpu")


def test_unscented_projection_drops_and_counts_non_finite_gaussians() -> None:
    """An overflowing Gaussian hides no other Gaussian."""
    gaussians = random_gaussians(2, count=5)
    means = gaussians.means.copy()
    means[1] = 3e38
    frame = ls.render(ls.Scene([replace(gaussians, means=means)]), lens(45.0), unscented(), device="cpu")
    assert np.isfinite(frame.color).all() and frame.alpha.max() > 0.0
