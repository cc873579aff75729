"""Interreflection between diffuse surfaces, compared with energy conservation and form factors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.demo.shapes import transform_mesh
from lumisplat.math.color import encode_srgb
from lumisplat.scene.lights import Light
from support.oracles.form_factors import opposed_squares, perpendicular_squares
from support.scenes.light_scenes import box
from support.scenes.path_scenes import (
    area_of,
    as_splats,
    assert_is,
    ball,
    diffuse,
    irradiance,
    irradiance_over,
    paths,
    quad,
)
from support.scenes.raster_scenes import similarity


def crowded_room(albedo: float) -> list[ls.Mesh]:
    """Returns the inside of the unit cube with a ball and a rotated box, all of one albedo and none touching."""
    x, y, z = np.eye(3)
    sides = ((0 * x, z, x), (y, x, z), (0 * x, x, y), (z, y, x), (0 * x, y, z), (x, z, y))
    globe = transform_mesh(ball(0.17, diffuse(albedo), rows=12), similarity(offset=(0.3, 0.2, 0.7)))
    crate = transform_mesh(
        box((0.3, 0.5, 0.2), diffuse(albedo)), similarity((0.0, 1.0, 0.0), 0.5, offset=(0.7, 0.3, 0.3))
    )
    return [*(quad(*side, diffuse(albedo)) for side in sides), globe, crate]


def board(albedo: float, emitted: float) -> list[ls.Mesh]:
    """Returns both sides of a free-standing square."""
    material = diffuse(albedo, emitted)
    up = quad((0.2, 0.7, 0.2), (0, 0, 0.3), (0.3, 0, 0), material)
    return [up, quad((0.2, 0.6999, 0.2), (0.3, 0, 0), (0, 0, 0.3), material)]


@pytest.mark.parametrize(
    ("source", "albedo"), [("point", 0.5), ("mesh", 0.5), ("rect", 0.5), ("sphere", 0.5), ("sphere", 0.8)]
)
def test_mean_irradiance_in_a_closed_room_follows_energy_conservation(source: str, albedo: float) -> None:
    """With albedo rho, area A and power Phi, mean irradiance is Phi / (A (1 - rho)), whatever objects are inside."""
    center = (0.6, 0.75, 0.7)
    lights: dict[str, tuple[Light, float]] = {
        "point": (ls.LightPoint(center, intensity=1.0), 4.0 * np.pi),
        "rect": (ls.LightRect(center, (0.3, 0, 0), (0, 0, 0.2), intensity=10.0), np.pi * 10.0 * 0.06),
        "sphere": (ls.LightSphere(center, 0.1, intensity=10.0), np.pi * 10.0 * 4.0 * np.pi * 0.01),
    }
    light, power = lights.get(source, (None, 2.0 * np.pi * 10.0 * 0.09))
    meshes = [*crowded_room(albedo), *board(albedo, 10.0 if source == "mesh" else 0.0)]
    scene = ls.Scene(meshes=meshes, lights=[light] if light else [])
    found = irradiance_over(scene, meshes, samples=1, max_bounces=64, count=24_000)
    assert_is(found, power / (sum(map(area_of, meshes)) * (1.0 - albedo)))


def test_integrating_sphere_with_a_hole_loses_light_at_every_bounce() -> None:
    """Each bounce keeps the fraction rho (1 - f) for a hole with fraction f of the sphere's area."""
    albedo, rows = 0.8, 96
    whole = ball(1.0, diffuse(albedo), hollow=True, rows=rows)
    open_above = whole.positions[whole.indices].mean(axis=1)[:, 1] < np.cos(0.6)
    sphere = ls.Mesh(whole.positions, whole.indices[open_above], material=diffuse(albedo))
    reflected = albedo * area_of(sphere) / area_of(whole)
    scene = ls.Scene(meshes=[sphere], lights=[ls.LightPoint((0.0, 0.0, 0.0), intensity=1.0)])
    camera = ls.Camera.look_at((0.1, -0.4, 0.2), (0.6, -0.6, 1.0), width=48, height=32, fov_y=1.0)
    total = irradiance(paths(scene, camera, 16, 64), albedo)
    assert_is(total, 1.0 + reflected / (1.0 - reflected), share=0.005)


def test_light_bounces_between_parallel_plates_match_the_closed_form() -> None:
    """The radiosities are J1 = (M1 + rho1 M2) / (1 - rho1 rho2), and J2 likewise, in each channel."""
    emitted = np.array([[1.0, 0.2, 0.0], [0.0, 0.5, 2.0]])
    albedo = np.array([[0.2, 0.5, 0.8], [0.9, 0.6, 0.3]])
    materials = [
        ls.MaterialPbr(base_color=rho, specular=0.0, roughness=1.0, emissive=emission)
        for rho, emission in zip(albedo, emitted, strict=True)
    ]
    wide = 2e3
    corner = -0.5 * wide
    below = quad((corner, 0, corner), (0, 0, wide), (wide, 0, 0), materials[0])
    above = quad((corner, 1, corner), (wide, 0, 0), (0, 0, wide), materials[1])
    camera = ls.Camera.look_at((0, 0.5, 0.01), (0, 0, 0), (0, 0, -1), width=32, height=24, fov_y=0.05)
    seen = paths(ls.Scene(meshes=[below, above]), camera, 64, 64).color
    truth = (emitted[0] + albedo[0] * emitted[1]) / (1.0 - albedo[0] * albedo[1])
    for channel in range(3):
        assert_is(seen[..., channel].astype(np.float64), truth[channel])


@pytest.mark.parametrize("backend", ["mesh", "rect"])
@pytest.mark.parametrize(
    ("arrangement", "factor"),
    [("opposed", opposed_squares(1.0)), ("wide", opposed_squares(10.0)), ("perpendicular", perpendicular_squares())],
)
def test_direct_light_of_one_square_on_another_equals_their_form_factor(
    arrangement: str, factor: float, backend: str
) -> None:
    """The mean over the receiving square is compared."""
    side = 10.0 if arrangement == "wide" else 1.0
    u, v = np.array([side, 0, 0]), np.array([0, 0, side])
    receiver = quad((0, 0, 0), v, u, diffuse(0.5))
    corner, edges = np.array([0.0, 1.0, 0.0]), (u, v)
    if arrangement == "perpendicular":
        corner, edges = np.zeros(3), (u, np.array([0.0, 1.0, 0.0]))
    lights: Sequence[Light] = []
    meshes = [receiver]
    if backend == "mesh":
        meshes.append(quad(corner, *edges, diffuse(0.0, 1.0 / np.pi)))
    else:
        lights = [ls.LightRect(corner + 0.5 * (edges[0] + edges[1]), *edges, intensity=1.0 / np.pi)]
    found = irradiance_over(ls.Scene(meshes=meshes, lights=lights), [receiver], samples=8, max_bounces=0)
    assert_is(found, factor)


def emitting_splats(mesh: ls.Mesh, albedo: float, count: int) -> ls.SplatInstance:
    """Returns a surface of Gaussians that emit 1 and reflect ``albedo``."""
    gaussians = as_splats(mesh, count).gaussians
    shown = np.full((count, 1, 3), (encode_srgb(albedo) - 0.5) / SH_C0)  # the SH colour scales emission and reflection
    emissive = ls.MaterialPbr(specular=0.0, roughness=1.0, emissive=(1.0 / albedo,) * 3)
    return ls.SplatInstance(replace(gaussians, sh=shown), material=emissive)


@pytest.mark.parametrize(("albedo", "bounces"), [(0.5, 1), (0.5, 32), (0.7, 64)])
def test_light_in_a_closed_ball_of_emitting_gaussians_equals_the_geometric_series(albedo: float, bounces: int) -> None:
    """A hollow ball of Gaussians lies in a mesh ball; transmitted light fits the series, because all surfaces emit."""
    shell = ball(1.2, diffuse(albedo, 1.0), hollow=True, rows=24)
    inner = ball(1.0, diffuse(albedo), hollow=True, rows=24)
    scene = ls.Scene([emitting_splats(inner, albedo, 3000)], [shell])
    camera = ls.Camera.look_at((0.1, 0.2, 0.3), (0.5, 0.4, 1.0), width=32, height=24, fov_y=1.0)
    frame = paths(scene, camera, 16, bounces)
    assert_is(frame.color[..., 1].astype(np.float64), (1.0 - albedo ** (bounces + 2)) / (1.0 - albedo), share=0.005)


@pytest.mark.parametrize("bounces", [0, 8])
def test_floor_of_gaussians_receives_light_from_an_adjacent_wall(bounces: int) -> None:
    """In a furnace, the wall's light counts although the wall is within the extent of the floor's Gaussians."""
    albedo = 0.5
    walls = [replace(wall, material=diffuse(albedo, 1.0)) for wall in crowded_room(albedo)[:6]]
    floor = quad((0, 0.2, 0), (0, 0, 1), (1, 0, 0), diffuse(albedo))
    scene = ls.Scene([emitting_splats(floor, albedo, 300)], walls)
    camera = ls.Camera.look_at((0.5, 0.7, 0.5), (0.97, 0.2, 0.97), width=32, height=24, fov_y=0.08)
    seen = paths(scene, camera, 16, bounces).color[..., 1].astype(np.float64)
    assert_is(seen, (1.0 - albedo ** (bounces + 2)) / (1.0 - albedo), share=0.005)
