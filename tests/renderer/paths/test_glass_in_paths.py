"""Glass in path tracing: with alpha, and with scattering of the light that is not transmitted."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.oracles.form_factors import polygon_irradiance
from support.scenes.path_scenes import assert_is, ball, diffuse, paths, quad

VIEW = ls.Camera.look_at((0, 0, -3), (0, 0, 0), width=16, height=12, fov_y=0.05)
ENVIRONMENT = ls.LightEnvironment(color=(1.0, 1.0, 1.0))
GLASS = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), transmission=1.0, roughness=0.0, ior=1.5)


@pytest.mark.parametrize("behind", ["wall", "sky"])
def test_alpha_blended_glass_absorbs_no_light_outside_its_body(behind: str, caplog: pytest.LogCaptureFixture) -> None:
    """For every alpha, rays that enter also leave, and nothing in front of or behind the body absorbs."""
    caplog.set_level(logging.WARNING)
    tinted = replace(
        GLASS, ior=1.0, specular=0.0, attenuation_color=(0.8, 0.8, 0.8), attenuation_distance=1.0, alpha_mode="blend"
    )
    body = ls.box(np.array([4.0, 4.0, 1.0]))
    wall = quad((-9, -9, 5), (0, 18, 0), (18, 0, 0), diffuse(0.0, 1.0))
    for alpha in (1.0, 0.5):
        body = replace(body, material=replace(tinted, alpha=alpha))
        scene = ls.Scene(meshes=[body, wall]) if behind == "wall" else ls.Scene(meshes=[body], lights=[ENVIRONMENT])
        np.testing.assert_allclose(paths(scene, VIEW, 4, 8, background=None).color, 0.8, rtol=5e-4)
    assert "without entering it" not in caplog.text


@pytest.mark.parametrize("roughness", [0.0, 0.3])
def test_alpha_blended_clear_glass_is_invisible_in_a_white_furnace(
    roughness: float, caplog: pytest.LogCaptureFixture
) -> None:
    """The glass is smooth or rough, of alpha 0.5; no warning about rays that leave without entering is logged."""
    caplog.set_level(logging.WARNING)
    material = replace(GLASS, roughness=roughness, alpha_mode="blend", alpha=0.5)
    near = ls.Camera.look_at((0, 0, -2), (0, 0, 0), width=16, height=12, fov_y=0.1)
    white = paths(ls.Scene(meshes=[ball(0.3, material, rows=24)], lights=[ENVIRONMENT]), near, 32, 32, background=None)
    values = white.color[..., 1].astype(np.float64)
    error = values.std() / np.sqrt(values.size)
    assert error < 0.0025
    assert 0.985 < values.mean() < 1.0 + 4.0 * error
    assert "without entering it" not in caplog.text


def test_emissive_glass_lights_a_floor_in_proportion_to_its_alpha() -> None:
    """Light samples on the triangles and rays that hit them give the floor the same light."""
    emissive = replace(GLASS, ior=1.0, specular=0.0, emissive=(1.0, 1.0, 1.0), alpha_mode="blend", alpha=0.5)
    floor = quad((-1, -1, 0), (0, 2, 0), (2, 0, 0), diffuse(0.5))
    lid = ls.MeshInstance(replace(ls.box(np.array([8.0, 8.0, 0.1])), material=emissive), position=(0.0, 0.0, -1.0))
    view = ls.Camera.look_at((0, 0, -0.5), (0, 0, 0), (0, 1, 0), width=16, height=12, fov_y=0.02)
    values = np.pi / 0.5 * paths(ls.Scene(meshes=[floor, lid]), view, 64, 4).color[..., 1].astype(np.float64)
    # A ray crosses two faces of the lid, each of which adds half of the emission.
    below = np.array([(-4, -4, -0.95), (-4, 4, -0.95), (4, 4, -0.95), (4, -4, -0.95)])
    truth = polygon_irradiance((0, 0, 0), (0, 0, -1), below)
    assert_is(values, truth)


@pytest.mark.parametrize("inside", [False, True])
def test_partly_diffuse_white_glass_in_a_white_furnace_has_little_noise(inside: bool) -> None:
    """White glass is in a white environment; light is not sampled in directions of total internal reflection.

    Light beyond the bounce limit is missing.
    """
    body = ball(0.3, replace(GLASS, transmission=0.2), rows=24)
    eye_and_target = ((0, 0, 0), (0, 0, 1)) if inside else ((0, 0, -2), (0, 0, 0))
    view = ls.Camera.look_at(*eye_and_target, width=32, height=24, fov_y=0.2)
    values = paths(ls.Scene(meshes=[body], lights=[ENVIRONMENT]), view, 8, 32).color[..., 1].astype(np.float64)
    error = values.std() / np.sqrt(values.size)
    assert error < 0.012
    assert (0.85 if inside else 0.95) < values.mean() < 1.0 + 4.0 * error
