"""Rasterised frames with lens distortion agree with rays that follow the lens."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.demo.shapes import sphere
from lumisplat.frame.redistorted import undistorted_camera
from support.scenes.raster_scenes import front_camera, one_gaussian, quad, random_gaussians

FOX = (0.0578421, -0.0805099, 0.0, 0.0, -0.000980296, 0.00015575)
BARREL = (-0.28, 0.09, -0.012, 0.0, 0.0006, -0.0011)
CUSHION = (0.21, 0.03, 0.01, 0.002, 0.004, -0.003)
LENSES = {"fox": FOX, "barrel": BARREL, "cushion": CUSHION}
NONE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def camera_of(lens: Any, **changes: Any) -> ls.Camera:
    """Makes a camera whose image corners are 38 degrees off the axis."""
    return front_camera(96, 72, 76.0, distortion=lens, **changes)


def shown(scene: ls.Scene, camera: ls.Camera, pipeline: ls.Pipeline, **settings: Any) -> ls.Frame:
    """Renders a frame on the CPU."""
    return ls.render(scene, camera, ls.RenderConfig(pipeline=pipeline, **settings), device="cpu")


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_rasterised_meshes_through_distorted_lenses_equal_traced_meshes(lens):
    """A tilted square has the same curved edge, colour, depth and normal as when ray traced."""
    scene = ls.Scene([], [quad(4.0, 1.6, tilt=0.4)])
    camera = camera_of(lens)
    raster, trace = (
        shown(scene, camera, pipeline, lighting=False) for pipeline in (ls.Pipeline.RASTER, ls.Pipeline.TRACE)
    )
    assert 0.2 < trace.alpha.mean() < 0.9
    # Resampling smooths the edge, so that the raster frame is closer to 64 rays a pixel than one ray a pixel is.
    exact = shown(scene, camera, ls.Pipeline.TRACE, samples=64, lighting=False)
    assert np.abs(raster.alpha - exact.alpha).mean() < np.abs(trace.alpha - exact.alpha).mean()
    assert abs(float(raster.alpha.mean() - exact.alpha.mean())) < 0.004
    inside = (raster.alpha == 1.0) & (trace.alpha == 1.0)
    np.testing.assert_allclose(raster.color[inside], trace.color[inside], atol=1e-5)
    np.testing.assert_allclose(raster.depth[inside], trace.depth[inside], rtol=0.01)
    np.testing.assert_allclose(raster.normal[inside], trace.normal[inside], atol=1e-5)
    np.testing.assert_array_equal(raster.instance_index[inside], trace.instance_index[inside])


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.HYBRID])
@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_depth_of_rasterised_distorted_frames_equals_the_depth_of_rays(lens: Any, pipeline: ls.Pipeline) -> None:
    """A floor's depth agrees with rays up to rounding, even beside the edge of a ball; a ball's depth within 1e-3."""
    floor = quad(8.0, 6.0, tilt=1.2)
    ball = ls.MeshInstance(sphere(0.9, rows=64), position=(0.3, 0.2, 4.0))
    scene = ls.Scene([], [floor, ball], [ls.LightPoint((0.0, -4.0, 0.0), intensity=9.0)])
    still = {"realtime": ls.RealtimeConfig(antialiasing=False)} if pipeline is ls.Pipeline.REALTIME else {}
    frame = shown(scene, camera_of(lens), pipeline, **still)
    exact = shown(scene, camera_of(lens), ls.Pipeline.TRACE)
    same = (frame.instance_index == exact.instance_index) & np.isfinite(exact.depth)
    for number, share, limit in ((0, 1.0, 2e-6), (1, 0.9, 1e-3)):
        rows = same & (exact.instance_index == number)
        errors = np.abs(frame.depth[rows] / exact.depth[rows] - 1.0)
        assert rows.sum() > 300
        assert np.quantile(errors, share) < limit
        error = np.linalg.norm(frame.position[rows] - exact.position[rows], axis=1) / exact.depth[rows]
        np.testing.assert_allclose(error, errors, atol=1e-5)


@pytest.mark.parametrize(
    "lens",
    [pytest.param(lens, id=name, marks=[] if name == "barrel" else pytest.mark.deep) for name, lens in LENSES.items()],
)
def test_depth_of_realtime_distorted_frames_equals_the_depth_of_rays(lens: Any) -> None:
    """Real-time frames hit the same first surfaces as the other pipelines."""
    test_depth_of_rasterised_distorted_frames_equals_the_depth_of_rays(lens, ls.Pipeline.REALTIME)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_rasterised_and_traced_frames_differ_no_more_with_lens_distortion_than_without(lens):
    """With lens distortion, raster and rays without a footprint differ no more than without distortion."""
    scene = ls.Scene([random_gaussians(5, count=400, center=(0, 0, 5), extent=(2.5, 2.0, 0.5))])
    difference = []
    for one in (NONE, lens):
        raster = shown(scene, camera_of(one), ls.Pipeline.RASTER)
        thin = ls.TraceConfig(dilation=0.0, hit_distance=ls.config.HitDistance.PEAK)
        trace = shown(scene, camera_of(one), ls.Pipeline.TRACE, trace=thin)
        difference.append(np.sqrt(np.mean((raster.color - trace.color) ** 2)))
    assert difference[1] < 1.15 * difference[0]


def test_points_seen_through_a_distorted_lens_appear_at_the_pixel_of_opencvs_formula():
    """A small Gaussian off the axis appears at the pixel of OpenCV's formula."""
    camera = camera_of(BARREL)
    u, v = 0.5, -0.35
    k1, k2, k3, _, p1, p2 = BARREL
    s = u * u + v * v
    radial = 1 + k1 * s + k2 * s**2 + k3 * s**3
    x = u * radial + 2 * p1 * u * v + p2 * (s + 2 * u * u)
    y = v * radial + p1 * (s + 2 * v * v) + 2 * p2 * u * v
    frame = shown(ls.Scene([one_gaussian((4 * u, 4 * v, 4.0), 0.05, 0.9)]), camera, ls.Pipeline.RASTER)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    center = [float((frame.alpha * coordinate).sum() / frame.alpha.sum()) for coordinate in (columns, rows)]
    assert center == pytest.approx([camera.fx * x + camera.cx, camera.fy * y + camera.cy], abs=0.05)


def test_all_layers_of_lit_frames_through_distorted_lenses_are_resampled():
    """All images have the camera's size and are finite; uncovered pixels show the background."""
    light = ls.LightPoint((1, -2, 2), intensity=30.0)
    scene = ls.Scene([random_gaussians(6)], [quad(5.0, 0.8)], [light])
    camera = camera_of(FOX)
    aovs = ("albedo", "emission", "reflection", "lights", "hits")
    frame = shown(scene, camera, ls.Pipeline.HYBRID, aovs=aovs, background=(0.1, 0.2, 0.3))
    assert frame.camera is camera
    for name, image in frame.arrays().items():
        if name != "light_names":
            assert image.shape[:2] == (72, 96) or image.shape[1:3] == (72, 96), name
            assert name in ("depth", "depth_z") or np.isfinite(image).all(), name
    corner = frame.pixels_srgb()[0, 0]
    if frame.alpha[0, 0] == 0.0:
        np.testing.assert_allclose(corner, (0.1, 0.2, 0.3), atol=1e-5)


def test_background_appears_beyond_the_fold_of_the_distortion_polynomial():
    """Beyond the fold of the polynomial the background appears, not a second image of the centre."""
    camera = front_camera(96, 72, 60.0, distortion=(-0.4, 0.0, 0.0, 0.0, 0.0, 0.0))
    missing = (camera.ray_directions() == 0.0).all(axis=2)
    assert missing.any()
    # A pixel on the fold itself is partly covered.
    around = np.pad(missing, 1, mode="edge")
    missing &= around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:]
    frame = shown(ls.Scene([], [quad(4.0, 40.0)]), camera, ls.Pipeline.RASTER, background=(1.0, 0.0, 0.0))
    assert (frame.alpha[missing] == 0.0).all() and (frame.instance_index[missing] == -1).all()
    np.testing.assert_array_equal(frame.color[missing], np.broadcast_to((1.0, 0.0, 0.0), (int(missing.sum()), 3)))


def test_raster_pipeline_refuses_distorted_lenses_near_180_degrees_and_to_resume_distorted_frames():
    """A lens near 180 degrees would need an unbounded pinhole image; a resumed frame would be filtered twice."""
    with pytest.raises(ls.SceneError, match=r"undistorted image of .* use Pipeline.TRACE"):
        undistorted_camera(front_camera(96, 72, 60.0, distortion=(-0.3, 0.045, 0.0, 0.0, 0.0, 0.0), fx=40.0, fy=40.0))
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID)
    scene = ls.Scene([one_gaussian()])
    renderer = ls.create_renderer(config, "cpu")
    frame = renderer.render(scene, camera_of(FOX))
    with pytest.raises(ls.ConfigError, match="cannot be resumed"):
        renderer.render(scene, camera_of(FOX), resume=frame)
