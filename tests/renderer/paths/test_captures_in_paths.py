"""Captures that keep their look, in frames of paths: pictures that are blended, and that shine."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.path_scenes import assert_is, diffuse, paths, quad, wide_sheet
from support.scenes.raster_scenes import front_camera, random_gaussians

SAMPLES = 400


def picture(z: float, opacity: float, color: tuple[float, float, float]) -> ls.SplatInstance:
    """A sheet that shows a colour as captured, display-referred."""
    sheet = wide_sheet(z, opacity, 0.5).gaussians
    sh = (np.array(color, np.float32).reshape(1, 1, 3) - 0.5) / 0.28209479177387814
    return ls.SplatInstance(replace(sheet, sh=sh, albedo=None, normals=None))


def linear(color: float) -> float:
    """sRGB, decoded."""
    return ((color + 0.055) / 1.055) ** 2.4


def view(samples_of: int = 8) -> ls.Camera:
    """Along z, through sheets, narrow."""
    return ls.Camera.look_at((0, 0, -1), (0, 0, 1), width=samples_of, height=samples_of, fov_y=0.01)


def test_a_capture_that_is_alone_is_blended_as_traced() -> None:
    """To the bit, with one sample: what is a picture has no grain."""
    capture = ls.Scene(splats=[random_gaussians(3)])
    settings = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=1)
    traced = ls.render(capture, front_camera(32, 24), replace(settings, pipeline=ls.Pipeline.TRACE), device="cpu")
    frame = ls.render(capture, front_camera(32, 24), settings, device="cpu")
    np.testing.assert_array_equal(frame.captured, traced.color)
    np.testing.assert_array_equal(frame.light, 0.0)


def test_a_mirror_shows_the_blend_decoded() -> None:
    """Half of black before white is the display's half in a mirror too, which is less light than half of white."""
    mirror = quad(
        (-5, -5, -2), (10, 0, 0), (0, 10, 0), ls.MaterialPbr(base_color=(1, 1, 1), metallic=1.0, roughness=0.0)
    )
    behind = [picture(-5.0, 0.5, (0.0, 0.0, 0.0)), picture(-7.0, 0.999, (1.0, 1.0, 1.0))]
    camera = ls.Camera.look_at((0, 0, -4), (0, 0, 1), width=4, height=4, fov_y=0.01)
    shown = paths(ls.Scene(meshes=[mirror], splats=behind), camera, 4, 2).color
    np.testing.assert_allclose(shown, linear(0.5), rtol=0.02)  # the sheets' alpha ends at 0.99


def test_haze_that_is_kept_before_what_is_lit() -> None:
    """A ray shows either, each with its share: a picture of opacity 0.3 before a lit sheet of opacity 0.8."""
    scene = ls.Scene(
        splats=[picture(0.0, 0.3, (0.8, 0.8, 0.8)), wide_sheet(1.0, 0.8, 0.5)],
        lights=[ls.LightDirectional((0, 0, 1), intensity=2.0, casts_shadow=False)],
    )
    frame: Any = paths(scene, view(), SAMPLES, 0)
    lit = 0.5 * 2.0 / np.pi
    assert_is(frame.light[..., 1], 0.7 * 0.8 * lit)
    captured = frame.captured[..., 1]
    assert_is(captured, 0.3 * 0.8)


def test_a_lamp_behind_haze_is_as_bright_as_what_gets_through() -> None:
    """To the camera, which sees a share of it, whether or not the haze has an iso-opacity surface."""
    for opacity in (0.2, 0.6):
        scene = ls.Scene(
            splats=[picture(0.0, opacity, (0.0, 0.0, 0.0)), picture(3.0, 0.5, (0.0, 0.0, 0.0))],
            lights=[ls.LightRect((0, 0, 2), (0, 3, 0), (3, 0, 0), intensity=1.0)],
        )
        frame: Any = paths(scene, view(), 16, 0)
        alone: Any = paths(replace(scene, splats=()), view(), 16, 0)
        assert alone.light.max() > 0.0
        np.testing.assert_allclose(frame.light, (1.0 - opacity) * alone.light, rtol=2e-3)


def test_a_panel_behind_a_panel_lights_by_what_gets_through() -> None:
    """A white picture of opacity 0.5 before black: the floor between receives half of the decoded white, blended."""
    floor = quad((-1, 0, -1), (0, 0, 2), (2, 0, 0), diffuse(0.6))
    turn = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
    lids = [
        ls.SplatInstance(picture(z, opacity, color).gaussians, turn)
        for z, opacity, color in ((1.0, 0.5, (1.0, 1.0, 1.0)), (2.0, 0.999, (0.0, 0.0, 0.0)))
    ]
    above = ls.Camera.look_at((0, 0.5, 0), (0, 0, 0), (0, 0, 1), width=16, height=16, fov_y=0.05)
    frame: Any = paths(ls.Scene(meshes=[floor], splats=lids), above, 32, 1)
    # Sideways, the sheets are as opaque: they are far wider than they are far away.
    np.testing.assert_allclose(frame.color, 0.6 * linear(0.5), rtol=0.01)


@pytest.mark.parametrize("primary", list(ls.config.PathPrimary))
def test_what_paths_meet_first(primary: ls.config.PathPrimary) -> None:
    """Two lit sheets of unlike albedo: the iso surface blends them and lights the blend, particles are lit one by one.

    Their display-referred means differ, as light does not.
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
def test_a_lamp_behind_a_lit_sheet_is_as_bright_for_either_primary(opacity: float) -> None:
    """Where the sheet is blended, too: by what gets through, whether or not it has an iso-opacity surface."""
    lamp = ls.LightRect((0, 0, 2), (0, 3, 0), (3, 0, 0), intensity=1.0)
    scene = ls.Scene(splats=[wide_sheet(0.0, opacity, 0.0)], lights=[lamp])
    for primary in ls.config.PathPrimary:
        frame = paths(scene, view(), 256, 0, path=ls.PathConfig(primary=primary))
        np.testing.assert_allclose(frame.color.mean(), 1.0 - opacity, rtol=0.02)


def test_stochastic_shadows_are_as_bright_as_exact_ones() -> None:
    """Through haze, off the middle of a lamp: what hides a point of the lamp is no matter of which point it is."""
    floor = quad((-4, 0, -4), (0, 0, 8), (8, 0, 0), diffuse(0.8))
    turn = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
    haze = ls.SplatInstance(
        wide_sheet(1.0, 0.5, 0.0).gaussians, turn, material=ls.MaterialPbr(specular=0.0, roughness=1.0)
    )
    lamp = ls.LightRect((0, 2, 0), (3, 0, 0), (0, 0, 3), intensity=1.0, visible=False)
    scene = ls.Scene(meshes=[floor], splats=[haze], lights=[lamp])
    down = ls.Camera.look_at((1.5, 0.5, 0.7), (1.5, 0, 0.7), (0, 0, 1), width=16, height=16, fov_y=0.02)
    means = [
        paths(scene, down, 128, 0, shadow_rays=ls.ShadowConfig(method=method)).color.mean()
        for method in (ls.config.ShadowMethod.EXACT, ls.config.ShadowMethod.STOCHASTIC)
    ]
    assert means[0] > 0.01
    np.testing.assert_allclose(means[1], means[0], rtol=0.02)
