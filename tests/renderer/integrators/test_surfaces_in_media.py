"""Opaque bodies under water: reflection by the index relative to the water, without loss of energy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.path_scenes import ball, quad, wide_sheet

TRACED = pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.HYBRID, ls.Pipeline.PATH])
AHEAD = ls.Camera.look_at((0, 0, -3), (0, 0, 0), width=16, height=8, fov_y=0.002)
WATER = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.0, transmission=1.0, ior=1.33, specular=0.0)
"""Water whose surface reflects nothing at normal incidence."""
ENVIRONMENT = ls.LightEnvironment(color=(1.0, 1.0, 1.0))
FACING = ls.LightDirectional((0.0, 0.0, 1.0), intensity=np.pi)


def sea() -> ls.Mesh:
    """Returns a wide box of water from z = 0 on."""
    box = ls.box(np.array([40.0, 40.0, 8.0]))
    return replace(box, positions=box.positions + np.array([0.0, 0.0, 4.0], np.float32), material=WATER)


def facing(material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a square in the water that fills the view."""
    return quad((-1, -1, 1.0), (0, 2, 0), (2, 0, 0), material)


def color(scene: ls.Scene, pipeline: ls.Pipeline, samples: int = 1, **changes: Any) -> Any:
    """Returns the mean colour of a frame."""
    settings = ls.RenderConfig(pipeline=pipeline, samples=samples, lighting=True, **changes)
    return ls.render(scene, AHEAD, settings, device="cpu").color.mean(axis=(0, 1), dtype=np.float64)


@TRACED
@pytest.mark.parametrize("ior", [1.5, 1.33, 1.1, 1.0])
@pytest.mark.parametrize("thin_walled", [False, True])
def test_reflectance_under_water_depends_on_the_refractive_indices_of_water_and_surface(
    pipeline: ls.Pipeline, ior: float, thin_walled: bool
) -> None:
    """Black varnish, or a black pane, in white light reflects ((n1 - n2) / (n1 + n2))^2 for the indices n1 and n2."""
    black = ls.MaterialPbr(base_color=(0.0, 0.0, 0.0), roughness=0.0, ior=ior)
    if thin_walled:
        black = replace(black, transmission=1.0, thin_walled=True)
    is_path = pipeline is ls.Pipeline.PATH  # Russian roulette ends most of such dim paths
    found = color(ls.Scene(meshes=[sea(), facing(black)], lights=[ENVIRONMENT]), pipeline, 256 if is_path else 4)
    np.testing.assert_allclose(found, ((ior - 1.33) / (ior + 1.33)) ** 2, rtol=0.1 if is_path else 2e-3, atol=1e-9)


@TRACED
@pytest.mark.parametrize(("kind", "roughness"), [("mesh", 0.0), ("mesh", 0.5), ("capture", 0.5)])
def test_body_under_water_is_shaded_like_a_body_in_air_of_the_relative_refractive_index(
    pipeline: ls.Pipeline, kind: str, roughness: float
) -> None:
    """The test compares highlight and diffuse reflection of a light behind the camera."""
    by_chance = pipeline is ls.Pipeline.PATH and roughness == 0.0  # a path is mirrored or scattered at random

    def shown(ior: float, around: list[ls.Mesh]) -> Any:
        material = ls.MaterialPbr(base_color=(0.6, 0.6, 0.6), roughness=roughness, ior=ior)
        if kind == "mesh":
            scene = ls.Scene(meshes=[*around, facing(material)], lights=[FACING])
        else:
            capture = replace(wide_sheet(1.0, 0.999, 0.6), material=material)
            scene = ls.Scene(splats=[capture], meshes=around, lights=[FACING])
        return color(scene, pipeline, 256 if by_chance else 1, max_bounces=1, shadows=ls.Shadows.OFF)

    # One bounce is allowed, so that light that the water's surface reflects back is missing in both scenes.
    np.testing.assert_allclose(shown(1.6, [sea()]), shown(1.6 / 1.33, []), rtol=0.01 if by_chance else 2e-3)
    if roughness > 0.0:
        assert shown(1.6, []).mean() > 1.02 * shown(1.6 / 1.33, []).mean()


@pytest.mark.parametrize("ior", [1.6, 1.15])
@pytest.mark.parametrize("roughness", [0.0, 0.4])
def test_white_body_in_water_is_invisible_in_a_white_furnace(ior: float, roughness: float) -> None:
    """The white body lies in a ball of water, which is invisible as well."""
    white = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=roughness, ior=ior)
    water = ball(1.0, replace(WATER, specular=1.0), rows=16)
    camera = ls.Camera.look_at((0, 0, -4), (0, 0, 0), width=24, height=24, fov_y=0.3)
    settings = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=64, max_bounces=64, lighting=True)
    scene = ls.Scene(meshes=[water, ball(0.7, white, rows=16)], lights=[ENVIRONMENT])
    frame = ls.render(scene, camera, settings, device="cpu")
    assert frame.color.mean(dtype=np.float64) == pytest.approx(1.0, abs=0.01)
