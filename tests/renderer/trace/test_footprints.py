"""Ray footprints in closed form: how far a pixel widens a Gaussian, also for instances and mirrors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.raster_scenes import front_camera, one_gaussian, quad, random_gaussians, similarity
from support.scenes.trace_scenes import MIRROR

SMALL = 1e-3
"""Scale of a Gaussian that is a tenth of a pixel wide."""
MEAN = (0.31, -0.18, 2.0)
FISHEYE, ORTHOGRAPHIC = ls.CameraModel.FISHEYE, ls.CameraModel.ORTHOGRAPHIC


def traced(scene: ls.Scene, camera: ls.Camera, **changes: object) -> ls.Frame:
    """Renders a traced frame; ``changes`` are fields of ``TraceConfig``."""
    trace = replace(ls.TraceConfig(), **changes)
    return ls.render(
        scene, camera, ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False, trace=trace), device="cpu"
    )


def expected_alpha(camera: ls.Camera, area: np.ndarray, dilation: float) -> np.ndarray:
    """Returns a ball's alpha in each pixel, whose solid angle is ``area`` times that of a pixel on the axis."""
    directions = camera.ray_directions()
    along = directions @ np.array(MEAN)
    off2 = np.dot(MEAN, MEAN) - along**2
    variance = SMALL**2 + dilation * area / (camera.fx * camera.fy) * along**2
    alpha = 0.8 * np.exp(-0.5 * off2 / variance)
    return np.where((alpha >= 1.0 / 255.0) & (along > 0.0), alpha, 0.0)


@pytest.mark.parametrize("dilation", [0.3, 2.0])
@pytest.mark.parametrize("placed", [False, True])
def test_pinhole_footprint_of_a_gaussian_is_the_solid_angle_of_a_pixel(dilation: float, placed: bool) -> None:
    """The Gaussian is widened by the solid angle at its mean's distance, whatever the scale of the instance."""
    camera = front_camera(96, 64, 100.0)
    instance = ls.SplatInstance(one_gaussian(MEAN, SMALL, 0.8))
    if placed:
        turn = similarity((1.0, 2.0, 0.5), 0.7, 40.0, MEAN)
        instance = ls.SplatInstance(one_gaussian((0.0, 0.0, 0.0), SMALL / 40.0, 0.8), turn)
    frame = traced(ls.Scene([instance]), camera, dilation=dilation)
    expected = expected_alpha(camera, camera.ray_directions()[..., 2] ** 3, dilation)
    assert (expected > 0.0).sum() > 5
    np.testing.assert_allclose(frame.alpha, expected, atol=2e-4)


def test_fisheye_footprint_of_a_gaussian_is_the_solid_angle_of_a_pixel() -> None:
    """The solid angle of a fisheye pixel shrinks off the axis."""
    camera = front_camera(96, 64, 30.0, model=FISHEYE)
    angle = np.arccos(camera.ray_directions()[..., 2])
    frame = traced(ls.Scene([one_gaussian(MEAN, SMALL, 0.8)]), camera)
    np.testing.assert_allclose(frame.alpha, expected_alpha(camera, np.sinc(angle / np.pi), 0.3), atol=2e-4)


def test_pixel_footprint_behind_a_mirror_is_that_of_the_camera_mirrored_in_it() -> None:
    """The reflection in a mirror equals the flipped image of a mirrored camera."""
    splats = random_gaussians(61, 200, center=(0.0, 0.0, -2.0), extent=(1.5, 1.0, 0.5), scale_range=(0.002, 0.02))
    mirror = quad(1.0, 3.0, material=MIRROR)
    seen = traced(ls.Scene([splats], [mirror]), front_camera(64, 48, 60.0)).color
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])  # pose of the mirrored camera, which looks back
    behind[2, 3] = 2.0
    direct = traced(ls.Scene([splats]), front_camera(64, 48, 60.0, camera_from_world=behind)).color[:, ::-1]
    thin = traced(ls.Scene([splats]), front_camera(64, 48, 60.0, camera_from_world=behind), dilation=0.0).color[:, ::-1]
    # Rounding decides whether an alpha of about 1/255 is blended.
    assert np.abs(seen - direct).max() < 1.1 / 255.0 and np.abs(seen - direct).mean() < 1e-5
    assert np.abs(seen - thin).mean() > 1e-3


@pytest.mark.parametrize("why", ["antialiased", "antialiasing on", "orthographic"])
def test_dilation_setting_does_not_change_frames_in_which_gaussians_are_not_widened(why: str) -> None:
    """The frame equals that without dilation to the bit."""
    gaussians = random_gaussians(62, 200, scale_range=(0.005, 0.05))
    camera, changes = front_camera(48, 32, 40.0), {}
    if why == "antialiased":
        gaussians = replace(gaussians, antialiased=True)
    elif why == "antialiasing on":
        changes = {"antialiasing": ls.config.Antialiasing.ON}
    else:
        camera = front_camera(48, 32, 8.0, model=ORTHOGRAPHIC)
    frame = traced(ls.Scene([gaussians]), camera, **changes)
    thin = traced(ls.Scene([gaussians]), camera, dilation=0.0)
    assert thin.alpha.max() > 0.2
    for image in ("color", "alpha", "depth", "normal", "gaussian_index"):
        np.testing.assert_array_equal(getattr(frame, image), getattr(thin, image))


def test_antialiasing_set_to_off_dilates_even_captures_marked_as_antialiased() -> None:
    """Captures that are marked as antialiased are dilated, too."""
    plain = random_gaussians(63, 200, scale_range=(0.005, 0.05))
    camera = front_camera(48, 32, 40.0)
    off = traced(ls.Scene([replace(plain, antialiased=True)]), camera, antialiasing=ls.config.Antialiasing.OFF)
    np.testing.assert_array_equal(off.color, traced(ls.Scene([plain]), camera).color)


def test_ray_queries_do_not_widen_gaussians_by_a_footprint() -> None:
    """Results of `trace_rays` and `transmittance` do not depend on the dilation."""
    scene = ls.Scene([random_gaussians(64, 200, scale_range=(0.005, 0.05))])
    directions = front_camera(48, 32, 40.0).ray_directions().reshape(-1, 3)
    wide, thin = (
        ls.trace_rays(scene, np.zeros(3), directions, ls.RenderConfig(trace=ls.TraceConfig(dilation=d)), device="cpu")
        for d in (8.0, 0.0)
    )
    assert thin.transmittance.min() < 0.8
    np.testing.assert_array_equal(wide.radiance, thin.radiance)


def test_shadow_rays_do_not_widen_gaussians_by_a_footprint() -> None:
    """A Gaussian a tenth of a pixel wide casts equal shadows with wide dilation and with none."""
    lights = [ls.LightDirectional(direction=(0.0, 0.0, 1.0), intensity=3.0)]
    above = random_gaussians(65, 300, center=(0.0, 0.0, 2.0), extent=(1.0, 1.0, 0.5), scale_range=(0.002, 0.01))
    below = np.eye(4)
    below[2, 3] = -4.0
    scene, camera = ls.Scene([above], [quad(6.0, 3.0)], lights), front_camera(48, 32, 40.0, camera_from_world=below)
    wide, thin = (
        ls.render(
            scene,
            camera,
            ls.RenderConfig(pipeline=ls.Pipeline.TRACE, lighting=False, trace=ls.TraceConfig(dilation=d)),
            device="cpu",
        ).color
        for d in (8.0, 0.0)
    )
    np.testing.assert_array_equal(wide, thin)
    lit = ls.render(replace(scene, splats=()), camera, ls.RenderConfig(pipeline=ls.Pipeline.TRACE), device="cpu").color
    assert np.abs(lit - thin).max() > 0.01


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.TRACE])
def test_traced_depth_of_a_disc_does_not_depend_on_the_footprint(pipeline: ls.Pipeline) -> None:
    """A thin tilted disc has the depth of its plane, however far pixels widen it."""
    tilt = 0.6
    disc = one_gaussian(
        (0.0, 0.0, 3.0), (0.8, 0.8, 1e-4), 0.95, rotation=(np.cos(tilt / 2), np.sin(tilt / 2), 0.0, 0.0)
    )
    camera = front_camera(48, 32, 20.0)
    config = ls.RenderConfig(
        pipeline=pipeline, raster=ls.RasterConfig(dilation=8.0), trace=ls.TraceConfig(dilation=8.0)
    )
    frame = ls.render(ls.Scene([disc]), camera, config, device="cpu")
    normal = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    expected = 3.0 * normal[2] / (camera.ray_directions() @ normal)
    found = np.isfinite(frame.depth)
    assert found.sum() > 50
    np.testing.assert_allclose(frame.depth[found], expected[found], rtol=1e-4)
