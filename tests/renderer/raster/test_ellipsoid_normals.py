"""Rasterised Gaussians have the normals of traced ones with ``NormalMethod.ELLIPSOID``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.config import NormalMethod, Projection, RasterStrategy
from support.compare.backends import renderer_of
from support.scenes.lenses import LENSES, layers
from support.scenes.raster_scenes import flat_sh, front_camera, one_gaussian, quad, random_gaussians

ELLIPSOIDS = ls.RenderConfig(trace=ls.TraceConfig(normal_method=NormalMethod.ELLIPSOID))
UNSCENTED = ls.RasterConfig(projection=Projection.UNSCENTED)
LIGHT = ls.LightDirectional((0.3, 0.5, 1.0), intensity=3.0)
CAMERA = front_camera(96, 72, 450.0)


def small_gaussians() -> ls.Gaussians:
    """Returns a grid of Gaussians near the optical axis, most of which overlap their neighbours."""
    random = np.random.default_rng(4)
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 7), np.linspace(-0.2, 0.2, 5))
    means = np.stack([x.ravel(), y.ravel(), random.uniform(3.8, 4.2, x.size)], axis=-1)
    scales = np.exp(random.uniform(np.log(0.012), np.log(0.04), (x.size, 3)))
    rotations, opacities = random.normal(size=(x.size, 4)), random.uniform(0.5, 1.0, x.size)
    return ls.Gaussians(means, rotations, scales, opacities, flat_sh(random.uniform(0.0, 1.0, (x.size, 3))))


def degrees_between(one: ls.Frame, other: ls.Frame) -> np.ndarray:
    """Returns the angles between the normals of pixels that are half covered in both frames."""
    covered = (one.alpha > 0.5) & (other.alpha > 0.5)
    assert covered.sum() > 50
    return np.degrees(np.arccos(np.clip((one.normal * other.normal).sum(axis=-1)[covered], -1.0, 1.0)))


@pytest.mark.parametrize("is_lit", [False, True], ids=["captured", "relit"])
@pytest.mark.parametrize("raster", [ls.RasterConfig(), UNSCENTED], ids=["ellipses", "unscented"])
@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.HYBRID], ids=lambda pipeline: pipeline.value)
def test_rasterised_normals_of_ellipsoids_are_those_of_traced_frames(
    backend: str, pipeline: ls.Pipeline, raster: ls.RasterConfig, is_lit: bool
) -> None:
    """Ellipses and rays cover slightly different pixels; normals of planes are ten times farther off."""
    material, lights = (ls.MaterialPbr(), [LIGHT]) if is_lit else (None, [])
    scene = ls.Scene([ls.SplatInstance(small_gaussians(), material=material)], lights=lights)
    config = replace(ELLIPSOIDS, shadows=ls.Shadows.OFF, samples=1 if is_lit else None)
    frame = renderer_of(backend, replace(config, pipeline=pipeline, raster=raster)).render(scene, CAMERA)
    truth = ls.render(scene, CAMERA, replace(config, pipeline=ls.Pipeline.TRACE), device="cpu")
    planes = ls.render(scene, CAMERA, replace(config, trace=ls.TraceConfig()), device="cpu")
    assert degrees_between(frame, truth).mean() < 0.5
    assert degrees_between(planes, truth).mean() > 5.0
    if is_lit:
        shown = frame.alpha > 0.5
        assert np.abs(frame.color - truth.color)[shown].mean() < 0.002
        assert np.abs(planes.color - truth.color)[shown].mean() > 0.015


@pytest.mark.parametrize("name", ["barrel", "fisheye", "rolling shutter"])
def test_unscented_normals_of_ellipsoids_are_those_of_traced_frames_for_any_lens(name: str) -> None:
    """The rays of a rolling shutter start at other points in each row. Without dilation, ellipsoids are the same."""
    camera = LENSES[name]
    scene = ls.Scene([layers(camera)])
    sharp = ls.RenderConfig(raster=replace(UNSCENTED, dilation=0.0), trace=replace(ELLIPSOIDS.trace, dilation=0.0))
    frame = ls.render(scene, camera, sharp, device="cpu")
    truth = ls.render(scene, camera, replace(sharp, pipeline=ls.Pipeline.TRACE), device="cpu")
    assert np.quantile(degrees_between(frame, truth), 0.99) < 0.1


def test_normals_of_ellipsoids_change_no_other_image(backend: str) -> None:
    """Colours, depths and indices are those of a frame with normals of planes; so is the normal of a mesh."""
    scene = ls.Scene([random_gaussians(3, 200), random_gaussians(4, 200)], [quad(4.0, 0.8)])
    by_peaks = replace(ELLIPSOIDS.trace, hit_distance=ls.config.HitDistance.PEAK)
    for trace in (ELLIPSOIDS.trace, by_peaks):
        config = ls.RenderConfig(trace=trace, lighting=False)
        plain = replace(config, trace=replace(trace, normal_method=NormalMethod.PLANE))
        frame, planes = (renderer_of(backend, one).render(scene, front_camera()) for one in (config, plain))
        for name in ("color", "alpha"):
            np.testing.assert_allclose(getattr(frame, name), getattr(planes, name), atol=1e-6)
        np.testing.assert_allclose(frame.depth, planes.depth, rtol=1e-6)
        np.testing.assert_array_equal(frame.instance_index, planes.instance_index)
        assert (np.abs(frame.normal - planes.normal).max(axis=-1) > 0.05)[frame.alpha > 0.5].mean() > 0.5


def test_sampled_gaussians_have_the_normals_of_their_ellipsoids(backend: str) -> None:
    """A pixel of a single Gaussian has the same normal whether it is blended or sampled."""
    scene = ls.Scene([one_gaussian(scale=(0.5, 0.2, 0.3), rotation=(0.9, 0.2, 0.3, 0.1), opacity=0.9)])
    by_samples = replace(ELLIPSOIDS, samples=1, aovs=("hits",))
    stochastic = replace(by_samples, raster=ls.RasterConfig(strategy=RasterStrategy.STOCHASTIC))
    sampled, blended = (renderer_of(backend, one).render(scene, front_camera()) for one in (stochastic, by_samples))
    hit = (sampled.alpha == 1.0) & (blended.alpha > 0.5)
    assert 50 < hit.sum() < hit.size
    np.testing.assert_allclose(sampled.normal[hit], blended.normal[hit], atol=1e-5)


@pytest.mark.parametrize("raster", [ls.RasterConfig(), UNSCENTED], ids=["ellipses", "unscented"])
def test_stored_normals_of_relit_sets_replace_those_of_ellipsoids(raster: ls.RasterConfig) -> None:
    """The set beside it, which stores none, has the normals of ellipsoids."""
    gaussians = small_gaussians()
    up = np.tile([0.0, -1.0, 0.0], (gaussians.count, 1))
    storing = ls.SplatInstance(replace(gaussians, normals=up), material=ls.MaterialPbr())
    aside = ls.SplatInstance(
        replace(gaussians, means=gaussians.means + np.array([0.0, 0.55, 0.0])), material=ls.MaterialPbr()
    )
    camera = replace(CAMERA, height=144)
    config = replace(ELLIPSOIDS, raster=raster, shadows=ls.Shadows.OFF, samples=1)
    frame = ls.render(ls.Scene([storing, aside], lights=[LIGHT]), camera, config, device="cpu")
    of_storing = (frame.instance_index == 0) & (frame.alpha > 0.5)
    of_aside = (frame.instance_index == 1) & (frame.alpha > 0.5)
    assert of_storing.sum() > 500 and of_aside.sum() > 500
    assert frame.normal[of_storing][:, 1].max() < -0.99
    assert frame.normal[of_aside].std() > 0.2
