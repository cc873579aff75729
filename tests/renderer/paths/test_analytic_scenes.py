"""Path tracing of scenes with lighting in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.color import encode_srgb
from lumisplat.scene.lights import Light
from support.scenes.path_scenes import (
    as_splats,
    assert_is,
    ball,
    cube_without_ceiling,
    diffuse,
    irradiance,
    paths,
    quad,
    wide_sheet,
)

INSIDE = ls.Camera.look_at((0.1, 0.05, 0.2), (0.6, 0.3, 1.0), width=48, height=32, fov_y=1.0)
AT_THE_FLOOR = ls.Camera.look_at((0.5, 0.8, 0.5), (0.5, 0.0, 0.5), (0, 0, 1), width=24, height=24, fov_y=0.03)
KINDS = pytest.mark.parametrize("kind", ["mesh", "gaussians"])


def scene_of(mesh: ls.Mesh, kind: str, count: int) -> ls.Scene:
    """Returns a surface as a mesh or as Gaussians."""
    return ls.Scene(meshes=[mesh]) if kind == "mesh" else ls.Scene(splats=[as_splats(mesh, count)])


@KINDS
@pytest.mark.parametrize("albedo", [1.0, 0.5])
def test_ball_in_a_constant_environment_shows_its_albedo(kind: str, albedo: float) -> None:
    """Brightness is albedo times radiance; a white ball is invisible, edges included."""
    scene = scene_of(ball(0.3, diffuse(albedo)), kind, 4000)
    scene = replace(scene, lights=[ls.LightEnvironment(color=(0.7,) * 3)])
    camera = ls.Camera.look_at((0.0, 0.0, -2.0), (0.0, 0.0, 0.0), width=48, height=32, fov_y=0.1)
    frame = paths(scene, camera, 64, 16)
    assert frame.instance_index.max() == 0
    assert_is(frame.color[..., 1].astype(np.float64), 0.7 * albedo, share=0.005)


@pytest.mark.parametrize("shape", ["ball", "cube"])
@pytest.mark.parametrize("bounces", [0, 1, 3, 64])
def test_n_bounces_in_a_closed_furnace_give_n_terms_of_the_geometric_series(bounces: int, shape: str) -> None:
    """Every surface emits 1 and reflects half."""
    emissive = diffuse(0.5, 1.0)
    cube = [*cube_without_ceiling(emissive), quad((0, 1, 0), (1, 0, 0), (0, 0, 1), emissive)]
    scene = ls.Scene(meshes=cube if shape == "cube" else [ball(1.0, emissive, hollow=True, rows=16)])
    inside = ls.Camera.look_at((0.4, 0.5, 0.6), (0.9, 0.3, 0.8), width=48, height=32, fov_y=1.0)
    frame = paths(scene, inside, 16, bounces)
    truth = (1.0 - 0.5 ** (bounces + 2)) / 0.5  # direct light is one bounce of the emitted light
    assert_is(frame.color[..., 1].astype(np.float64), truth, share=0.005)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.1), (-0.6, 0.5, 0.2)])
def test_irradiance_by_bounces_in_an_integrating_sphere_is_the_same_everywhere(
    place: tuple[float, float, float],
) -> None:
    """Irradiance is rho Phi / (4 pi R^2 (1 - rho)) for a light of power Phi anywhere, albedo rho and radius R."""
    light = ls.LightPoint(place, intensity=1.0)
    scene = ls.Scene(meshes=[ball(1.0, diffuse(0.5), hollow=True, rows=96)], lights=[light])
    bounced = irradiance(paths(scene, INSIDE, 64, 64), 0.5) - irradiance(paths(scene, INSIDE, 64, 0), 0.5)
    assert_is(bounced, 0.5 * 4.0 * np.pi / (4.0 * np.pi * 0.5))


@pytest.mark.parametrize("light", ["mesh", "rect"])
@pytest.mark.parametrize(("albedo", "truth"), [(0.5, 1.2416), (0.8, 2.8002)])
def test_irradiance_in_a_cube_below_an_emitting_ceiling_matches_collocation(
    light: str, albedo: float, truth: float
) -> None:
    """The irradiance at the middle of the floor equals float64 collocation, and its direct part the form factor."""
    ceiling = quad((0, 1, 0), (1, 0, 0), (0, 0, 1), diffuse(albedo, 1.0 if light == "mesh" else 0.0))
    lights = [ls.LightRect((0.5, 0.99999, 0.5), (1, 0, 0), (0, 0, 1), intensity=1.0)] if light == "rect" else []
    scene = ls.Scene(meshes=[*cube_without_ceiling(diffuse(albedo)), ceiling], lights=lights)
    assert_is(irradiance(paths(scene, AT_THE_FLOOR, 64, 0), albedo), np.pi * 0.239456)
    assert_is(irradiance(paths(scene, AT_THE_FLOOR, 64, 64), albedo), truth)


@pytest.mark.parametrize("light", ["mesh", "rect", "sky"])
def test_light_seen_through_panes_of_refractive_index_1_is_counted_once(light: str) -> None:
    """Either refracted rays or light samples find the light, never both."""
    emitter = quad((-0.5, 1.0, -0.5), (1, 0, 0), (0, 0, 1), diffuse(0.5, 1.0 if light == "mesh" else 0.0))
    lights: dict[str, list[Light]] = {
        "mesh": [],
        "rect": [ls.LightRect((0.0, 0.999, 0.0), (1, 0, 0), (0, 0, 1), intensity=1.0)],
        "sky": [ls.LightEnvironment(color=(0.3,) * 3)],
    }
    clear = ls.MaterialPbr(base_color=(1.0,) * 3, roughness=0.0, transmission=1.0, ior=1.0001)
    pane = quad((-4, 0.7, -4), (8, 0, 0), (0, 0, 8), clear)
    floor = quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), diffuse(0.5))
    camera = ls.Camera.look_at((0, 0.5, 0.01), (0, 0, 0), (0, 0, -1), width=32, height=24, fov_y=0.02)
    emitters = [] if light == "sky" else [emitter]
    open_air, behind = (
        irradiance(paths(ls.Scene(meshes=[floor, *emitters, *panes], lights=lights[light]), camera, 64, 16), 0.5)
        for panes in ([], [pane])
    )
    assert behind.std() / np.sqrt(behind.size) < 0.01 * open_air.mean()
    np.testing.assert_allclose(behind.mean(), open_air.mean(), rtol=0.02)


@pytest.mark.parametrize("shadows", ["none of the light's", "short", "off"])
def test_environment_light_whose_shadows_are_off_lights_a_floor_below_a_roof(shadows: str) -> None:
    """Shadows are off, or the roof is beyond the shadow distance."""
    environment = ls.LightEnvironment(
        casts_shadow=shadows != "none of the light's", shadow_distance=0.5 if shadows == "short" else np.inf
    )
    floor = quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), diffuse(0.5))
    roof = quad((-9, 1.0, -9), (18, 0, 0), (0, 0, 18), diffuse(0.0))
    scene = ls.Scene(meshes=[floor, roof], lights=[environment])
    camera = ls.Camera.look_at((0, 0.5, 0.01), (0, 0, 0), (0, 0, -1), width=32, height=24, fov_y=0.02)
    frame = paths(scene, camera, 64, 0, shadows=ls.Shadows.OFF if shadows == "off" else ls.Shadows.HARD)
    assert_is(irradiance(frame, 0.5), np.pi)


@KINDS
def test_light_bounces_between_concentric_spheres_match_the_closed_form(kind: str) -> None:
    """The outer sphere emits; light bounces between the two spheres by the albedo of each channel."""
    inner, outer, share = 0.8, 0.5, 0.25
    matrix = np.array([[1.0, -inner], [-outer * share, 1.0 - outer * (1.0 - share)]])
    truth = np.linalg.solve(matrix, [0.0, 1.0])
    shell = ball(1.0, diffuse(outer, 1.0 / np.pi), hollow=True)
    around = ls.Scene(meshes=[shell])
    inside = ball(0.5, diffuse(inner))
    scene = (
        replace(around, meshes=[shell, inside])
        if kind == "mesh"
        else replace(around, splats=[as_splats(inside, 20_000)])
    )
    for target, expected in (((0.0, 0.0, 0.0), truth[0]), ((0.0, 0.0, -1.0), truth[1])):
        camera = ls.Camera.look_at((0.0, 0.0, -0.8), target, width=32, height=24, fov_y=0.2)
        values = np.pi * paths(scene, camera, 64, 32).color[..., 1].astype(np.float64)
        assert_is(values, expected, share=0.005)


@pytest.mark.parametrize("side", ["reflected", "transmitted"])
def test_light_bounces_between_two_gaussian_sheets_match_the_closed_form(side: str) -> None:
    """The sheets are wide Gaussians of opacity 0.6 and albedo 0.8; light bounces between the sheets and passes both."""
    reflectance, transmittance = 0.6 * 0.8, 0.4
    between = 1.0 / (1.0 - reflectance**2)
    truth = {
        "reflected": reflectance + transmittance**2 * reflectance * between,
        "transmitted": transmittance**2 * between,
    }[side]
    rows = 64
    around = 2.0 * np.pi * ((np.arange(2 * rows) + 0.5) / (2 * rows) - 0.5)
    behind_camera = np.repeat((np.cos(around) > 0.0)[None, :, None], rows, axis=0) * np.ones(3)
    environment = (behind_camera if side == "reflected" else 1.0 - behind_camera).astype(np.float32)
    scene = ls.Scene(
        splats=[wide_sheet(0.0, 0.6, 0.8), wide_sheet(1.0, 0.6, 0.8)],
        lights=[ls.LightEnvironment(environment)],
    )
    camera = ls.Camera.look_at((0.0, 0.0, -1.0), (0.0, 0.0, 0.0), width=32, height=32, fov_y=0.02)
    # With the default shadow offset, two surfaces of such wide Gaussians would count as one layer.
    small_offset = ls.ShadowConfig(offset=0.0, offset_absolute=0.01)
    frame = paths(scene, camera, 128, 32, shadow_rays=small_offset)
    assert_is(frame.color[..., 1].astype(np.float64), truth)


def test_panel_of_captured_gaussians_lights_a_floor_by_its_form_factor() -> None:
    """The panel is above the floor."""
    panel = quad((-0.5, 1.0, -0.5), (1, 0, 0), (0, 0, 1), diffuse(0.5))
    gaussians = ls.gaussians_from_mesh(panel, 40_000)
    shown = np.full((gaussians.count, 1, 3), (encode_srgb(0.5) - 0.5) / SH_C0)
    capture = ls.SplatInstance(replace(gaussians, sh=shown, albedo=None))
    floor = quad((-5, 0, -5), (0, 0, 10), (10, 0, 0), diffuse(0.5))
    camera = ls.Camera.look_at((0, 0.5, 0.01), (0, 0, 0), (0, 0, -1), width=32, height=24, fov_y=0.02)
    values = irradiance(paths(ls.Scene(splats=[capture], meshes=[floor]), camera, 128, 1), 0.5)
    assert values.std() / np.sqrt(values.size) < 0.005
    np.testing.assert_allclose(values.mean(), np.pi * 0.5 * 0.239456, rtol=0.02)


def test_visible_sphere_light_is_drawn_and_gives_its_closed_form_irradiance() -> None:
    """A sphere of radiance L and radius r at distance d gives irradiance pi L (r / d)^2, and is visible by default."""
    light = ls.LightSphere((0.0, 2.0, 0.0), 0.25, intensity=3.0)
    floor = quad((-5, 0, -5), (0, 0, 10), (10, 0, 0), diffuse(0.5))
    above = ls.Camera.look_at((0, 1.0, 0.01), (0, 0, 0), (0, 0, -1), width=24, height=24, fov_y=0.02)
    beside = ls.Camera.look_at((0, 1.0, 3.0), (0, 2, 0), width=16, height=16, fov_y=0.02)
    for visible in (True, False):
        scene = ls.Scene(meshes=[floor], lights=[replace(light, visible=visible)])
        below = irradiance(paths(scene, above, 16, 0), 0.5)
        np.testing.assert_allclose(below, np.pi * 3.0 * (0.25 / 2.0) ** 2, rtol=1e-3)
        frame = paths(scene, beside, 4, 0, background=None)
        np.testing.assert_allclose(frame.color, 3.0 * visible, rtol=1e-6)
        np.testing.assert_array_equal(frame.alpha, float(visible))
