"""Lights in, behind and beside absorbing bodies: Beer's law on the paths to the eye and to the light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.media_scenes import AHEAD, CLEAR, TRACED, color, slab
from support.scenes.path_scenes import diffuse, quad, wide_sheet

TINT = np.array([0.2, 0.5, 1.0])
BODY = replace(CLEAR, attenuation_color=TINT, attenuation_distance=1.0)
SLANT = np.array([0.6, 0.0, -0.8])
"""Direction from the surface at the origin to the lights."""


@dataclass(frozen=True)
class Case:
    """Layout of a test: a body of slabs across the z axis, a surface at z = 0, a light along `SLANT`, path lengths."""

    slabs: tuple[tuple[float, float], ...]
    light: float
    seen: float
    lit: float
    eye: float = -3.0


CASES = {
    "the light is inside": Case(((-2.0, -1.0),), light=2.0, seen=0.0, lit=0.75, eye=-0.5),
    "both are inside": Case(((-1.5, 1.0),), light=1.0, seen=1.5, lit=1.0),
    "the light is beyond": Case(((-1.2, 1.0),), light=2.5, seen=1.2, lit=1.5),
    "left, and entered again": Case(((-0.4, 1.0), (-2.5, -1.6)), light=2.5, seen=0.4, lit=1.0, eye=-1.0),
    "left, entered, and left": Case(((-0.4, 1.0), (-2.5, -1.6)), light=4.0, seen=0.4, lit=1.625, eye=-1.0),
}


def body(slabs: tuple[tuple[float, float], ...], material: ls.MaterialPbr) -> ls.Mesh:
    """Returns one mesh of several slabs."""
    parts = [slab(front, back, material) for front, back in slabs]
    indices = [part.indices + 24 * k for k, part in enumerate(parts)]
    return ls.Mesh(np.concatenate([part.positions for part in parts]), np.concatenate(indices), material=material)


def assert_absorbed(case: Case, light: ls.LightPoint | ls.LightSphere, pipeline: ls.Pipeline) -> None:
    """Asserts that the body dims the surface by the transmittance of the paths to the light and to the eye."""
    floor = quad((-9, -9, 0.0), (0, 18, 0), (18, 0, 0), diffuse(0.8))
    camera = ls.Camera.look_at((0, 0, case.eye), (0, 0, 0), width=16, height=8, fov_y=0.002)
    without, within = (
        color(ls.Scene(meshes=[floor, *bodies], lights=[light]), pipeline, 1, camera, max_bounces=1)
        for bodies in ([], [body(case.slabs, BODY)])
    )
    np.testing.assert_allclose(within / without, TINT ** (case.seen + case.lit), rtol=3e-3)


@TRACED
@pytest.mark.parametrize("name", CASES)
def test_absorbing_body_attenuates_light_on_its_way_in_and_on_its_way_to_the_camera(
    pipeline: ls.Pipeline, name: str
) -> None:
    """The light is a point, which rays cannot hit, so that its shadow rays pass through the body."""
    assert_absorbed(CASES[name], ls.LightPoint(CASES[name].light * SLANT, intensity=50.0), pipeline)


@TRACED
def test_absorbing_body_attenuates_visible_sphere_lights_inside_it(pipeline: ls.Pipeline) -> None:
    """Rays can hit the small sphere light, so that the body blocks shadow rays, and refracted rays find the light."""
    case = CASES["both are inside"]
    assert_absorbed(case, ls.LightSphere(case.light * SLANT, 0.001, intensity=2e7), pipeline)


@TRACED
def test_gaussians_inside_an_absorbing_body_are_lit_like_meshes(pipeline: ls.Pipeline) -> None:
    """The Gaussians inside the body are dimmed by the same transmittance as a mesh."""
    case = CASES["both are inside"]
    without, within = (
        color(
            ls.Scene([wide_sheet(0.0, 0.9, 0.8)], meshes=bodies, lights=[ls.LightPoint(case.light * SLANT)]),
            pipeline,
            64,
            max_bounces=1,
        )
        for bodies in ([], [body(case.slabs, BODY)])
    )
    np.testing.assert_allclose(within / without, TINT ** (case.seen + case.lit), rtol=3e-3)


@pytest.mark.parametrize("visible", [False, True])
def test_absorbing_rough_glass_attenuates_a_light_inside_it(visible: bool) -> None:
    """The light is sampled through the rough surface, whether or not rays can hit the light."""
    light = ls.LightSphere((0.0, 0.0, 1.0), 0.001, intensity=1e6, visible=visible)
    clear, dim = (
        color(
            ls.Scene(meshes=[slab(0.0, 5.0, replace(glass, roughness=0.4, ior=1.5))], lights=[light]),
            ls.Pipeline.PATH,
            16,
            AHEAD,
            max_bounces=0,
        )
        for glass in (CLEAR, BODY)
    )
    assert clear.min() > 0.0
    np.testing.assert_allclose(dim / clear, TINT**1.0, rtol=3e-3)
