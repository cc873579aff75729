"""Emissive captures in path tracing: they are blended, and emit light."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.path_scenes import assert_is, diffuse, paths, quad, wide_sheet
from support.scenes.raster_scenes import front_camera, random_gaussians

SAMPLES = 400


def captured_sheet(z: float, opacity: float, color: tuple[float, float, float]) -> ls.SplatInstance:
    """Returns a sheet that emits a captured colour, display-referred."""
    sheet = wide_sheet(z, opacity, 0.5).gaussians
    sh = (np.array(color, np.float32).reshape(1, 1, 3) - 0.5) / 0.28209479177387814
    return ls.SplatInstance(replace(sheet, sh=sh, albedo=None, normals=None))


def linear(color: float) -> float:
    """Returns the linear value of an sRGB-encoded colour."""
    return ((color + 0.055) / 1.055) ** 2.4


def view(samples_of: int = 8) -> ls.Camera:
    """Returns a narrow camera along z, through the sheets."""
    return ls.Camera.look_at((0, 0, -1), (0, 0, 1), width=samples_of, height=samples_of, fov_y=0.01)


def test_path_traced_emissive_capture_equals_the_trace_pipeline() -> None:
    """One path-traced sample has the bits of the traced frame, so that captures are not noisy."""
    capture = ls.Scene(splats=[random_gaussians(3)])
    settings = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=1)
    traced = ls.render(capture, front_camera(32, 24), replace(settings, pipeline=ls.Pipeline.TRACE), device="cpu")
    frame = ls.render(capture, front_camera(32, 24), settings, device="cpu")
    np.testing.assert_array_equal(frame.captured, traced.color)
    np.testing.assert_array_equal(frame.light, 0.0)


def test_path_traced_mirror_shows_captures_blended_in_display_encoded_values() -> None:
    """Half-transparent black over white gives the display value 0.5, which is less light than half of white."""
    mirror = quad(
        (-5, -5, -2), (10, 0, 0), (0, 10, 0), ls.MaterialPbr(base_color=(1, 1, 1), metallic=1.0, roughness=0.0)
    )
    behind = [captured_sheet(-5.0, 0.5, (0.0, 0.0, 0.0)), captured_sheet(-7.0, 0.999, (1.0, 1.0, 1.0))]
    camera = ls.Camera.look_at((0, 0, -4), (0, 0, 1), width=4, height=4, fov_y=0.01)
    shown = paths(ls.Scene(meshes=[mirror], splats=behind), camera, 4, 2).color
    np.testing.assert_allclose(shown, linear(0.5), rtol=0.02)  # the alpha of a sheet is at most 0.99


def test_path_traced_captured_haze_and_a_lit_sheet_behind_contribute_by_blend_weight() -> None:
    """A captured sheet of opacity 0.3 is in front of a lit one of 0.8; each contributes by its blend weight."""
    scene = ls.Scene(
        splats=[captured_sheet(0.0, 0.3, (0.8, 0.8, 0.8)), wide_sheet(1.0, 0.8, 0.5)],
        lights=[ls.LightDirectional((0, 0, 1), intensity=2.0, casts_shadow=False)],
    )
    frame: Any = paths(scene, view(), SAMPLES, 0)
    lit = 0.5 * 2.0 / np.pi
    assert_is(frame.light[..., 1], 0.7 * 0.8 * lit)
    captured = frame.captured[..., 1]
    assert_is(captured, 0.3 * 0.8)


def test_light_behind_captured_haze_is_scaled_by_its_transmittance() -> None:
    """The scaling holds in the camera's view, whether or not the haze has an iso-opacity surface."""
    for opacity in (0.2, 0.6):
        scene = ls.Scene(
            splats=[captured_sheet(0.0, opacity, (0.0, 0.0, 0.0)), captured_sheet(3.0, 0.5, (0.0, 0.0, 0.0))],
            lights=[ls.LightRect((0, 0, 2), (0, 3, 0), (3, 0, 0), intensity=1.0)],
        )
        frame: Any = paths(scene, view(), 16, 0)
        alone: Any = paths(replace(scene, splats=()), view(), 16, 0)
        assert alone.light.max() > 0.0
        np.testing.assert_allclose(frame.light, (1.0 - opacity) * alone.light, rtol=2e-3)


def test_floor_below_overlapping_captured_panels_is_lit_by_their_blended_display_colour() -> None:
    """A white panel of opacity 0.5 covers a black one; the floor receives the decoded display value 0.5."""
    floor = quad((-1, 0, -1), (0, 0, 2), (2, 0, 0), diffuse(0.6))
    rotation = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
    lids = [
        ls.SplatInstance(captured_sheet(z, opacity, color).gaussians, rotation)
        for z, opacity, color in ((1.0, 0.5, (1.0, 1.0, 1.0)), (2.0, 0.999, (0.0, 0.0, 0.0)))
    ]
    above = ls.Camera.look_at((0, 0.5, 0), (0, 0, 0), (0, 0, 1), width=16, height=16, fov_y=0.05)
    frame: Any = paths(ls.Scene(meshes=[floor], splats=lids), above, 32, 1)
    # Rays at an angle have the same alpha, because the sheets are far wider than their distance.
    np.testing.assert_allclose(frame.color, 0.6 * linear(0.5), rtol=0.01)


@pytest.mark.parametrize("primary", list(ls.config.PathPrimary))
def test_path_tracer_lights_blended_materials_or_each_gaussian_as_the_setting_primary_says(
    primary: ls.config.PathPrimary,
) -> None:
    """Two lit sheets have different albedos: with primary iso their blend is lit, with particle each sheet.

    Blending albedos in display values and averaging lit colours give different means.
    """
    scene = ls.Scene(
        splats=[wide_sheet(0.0, 0.6, 0.1), wide_sheet(1.0, 0.9, 0.9)],
        lights=[ls.LightDirectional((0, 0, 1), intensity=np.pi, casts_shadow=False)],
    )
    frame: Any = paths(scene, view(), SAMPLES, 0, path=ls.PathConfig(primary=primary))
    if primary is ls.config.PathPrimary.PARTICLE:
        assert_is(frame.color[..., 1], 0.6 * 0.1 + 0.4 * 0.9 * 0.9)
    else:
        traced = ls.render(scene, view(), ls.RenderConfig(pipeline=ls.Pipeline.TRACE), device="cpu")
        np.testing.assert_allclose(frame.color, traced.color, rtol=1e-4)


@pytest.mark.parametrize("opacity", [0.3, 0.6])
def test_light_seen_through_a_lit_sheet_is_equal_for_both_values_of_the_setting_primary(opacity: float) -> None:
    """The light is equal whether or not the sheet has an iso-opacity surface."""
    light = ls.LightRect((0, 0, 2), (0, 3, 0), (3, 0, 0), intensity=1.0)
    scene = ls.Scene(splats=[wide_sheet(0.0, opacity, 0.0)], lights=[light])
    for primary in ls.config.PathPrimary:
        frame = paths(scene, view(), 256, 0, path=ls.PathConfig(primary=primary))
        np.testing.assert_allclose(frame.color.mean(), 1.0 - opacity, rtol=0.02)


def test_mean_of_stochastic_shadows_in_path_tracing_equals_exact_shadows() -> None:
    """The light is seen through haze, off its centre; all points of the light are blocked with equal probability."""
    floor = quad((-4, 0, -4), (0, 0, 8), (8, 0, 0), diffuse(0.8))
    rotation = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
    haze = ls.SplatInstance(
        wide_sheet(1.0, 0.5, 0.0).gaussians, rotation, material=ls.MaterialPbr(specular=0.0, roughness=1.0)
    )
    light = ls.LightRect((0, 2, 0), (3, 0, 0), (0, 0, 3), intensity=1.0, visible=False)
    scene = ls.Scene(meshes=[floor], splats=[haze], lights=[light])
    down = ls.Camera.look_at((1.5, 0.5, 0.7), (1.5, 0, 0.7), (0, 0, 1), width=16, height=16, fov_y=0.02)
    means = [
        paths(scene, down, 128, 0, shadow_rays=ls.ShadowConfig(method=method)).color.mean()
        for method in (ls.config.ShadowMethod.EXACT, ls.config.ShadowMethod.STOCHASTIC)
    ]
    assert means[0] > 0.01
    np.testing.assert_allclose(means[1], means[0], rtol=0.02)
