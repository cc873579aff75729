"""Direct light in closed form, for each sampling strategy of a path.

The strategies are light sampling, for lights that rays cannot hit; BSDF sampling, through a pane of index 1 that
blocks only shadow rays to visible lights; and multiple importance sampling of both.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.lights import Light
from support.oracles.bsdf_oracle import pbr_specular
from support.oracles.form_factors import polygon_irradiance
from support.scenes.light_scenes import metal, parallelogram
from support.scenes.path_scenes import assert_is, ball, diffuse, irradiance, paths, quad, wide_sheet

ALBEDO = 0.5
FLOOR = quad((-3, 0, -3), (0, 0, 6), (6, 0, 0), diffuse(ALBEDO))
CLEAR = ls.MaterialPbr(base_color=(1.0,) * 3, roughness=0.0, transmission=1.0, ior=1.0)
PANE = quad((-9, 0.4, -9), (18, 0, 0), (0, 0, 18), CLEAR)
"""Pane between the floor and all lights, which are above 0.5."""
CLOSE = ls.Camera.look_at((0, 0.3, 0.002), (0, 0, 0), (0, 0, -1), width=32, height=24, fov_y=0.002)
"""Camera on the origin, from below the pane."""
STRATEGIES = ("sampled", "hit", "both")


def lit_by(light: Light | ls.Mesh, strategy: str, surface: ls.Mesh = FLOOR) -> ls.Scene:
    """Returns a surface and a light that paths reach by one strategy."""
    meshes = [surface, PANE] if strategy == "hit" else [surface]
    if isinstance(light, ls.Mesh):
        return ls.Scene(meshes=[*meshes, light])
    if isinstance(light, ls.LightEnvironment):
        unmet = replace(light, shadow_distance=1e6)
    elif isinstance(light, ls.LightPoint):
        unmet = light
    else:
        unmet = replace(light, visible=False)
    return ls.Scene(meshes=meshes, lights=[unmet if strategy == "sampled" else light])


def found(light: Light | ls.Mesh, strategy: str, surface: ls.Mesh = FLOOR, samples: int = 64) -> np.ndarray:
    """Returns the irradiance at the origin, one value per pixel; light has not bounced, except through the pane."""
    return irradiance(paths(lit_by(light, strategy, surface), CLOSE, samples, 1 if strategy == "hit" else 0), ALBEDO)


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("place", [(0.0, 1.0, 0.0), (0.9, 1.2, -0.5)])
def test_path_traced_irradiance_of_a_sphere_light_matches_the_closed_form(
    place: tuple[float, float, float], strategy: str
) -> None:
    """Irradiance is pi L (r / d)^2 cos for radiance L, radius r and distance d."""
    light = ls.LightSphere(place, 0.45, intensity=2.0)
    distance = np.linalg.norm(place)
    truth = np.pi * 2.0 * (0.45 / distance) ** 2 * place[1] / distance
    assert_is(found(light, strategy), float(truth))


@pytest.mark.parametrize("strategy", ["hit", "both"])
def test_path_traced_irradiance_of_an_emissive_ball_is_the_sum_over_its_triangles(strategy: str) -> None:
    """The expected value is the sum over the front-facing triangles of the sphere."""
    source = ball(0.45, diffuse(0.0, 2.0), rows=24)
    source = replace(source, positions=source.positions + np.array([0.9, 1.2, -0.5]))
    corners = source.positions[source.indices].astype(np.float64)
    sums = [polygon_irradiance((0, 0, 0), (0, 1, 0), triangle) for triangle in corners]
    assert_is(found(source, strategy), 2.0 * -sum(value for value in sums if value < 0.0))


@pytest.mark.parametrize("strategy", ["hit", "both"])
def test_path_traced_irradiance_of_an_emissive_disc_matches_the_closed_form(strategy: str) -> None:
    """Irradiance is pi L r^2 / (r^2 + h^2) for radiance L, radius r and height h; the disc has many corners."""
    angles = 2.0 * np.pi * np.arange(96) / 96
    rim = np.stack([0.6 * np.cos(angles), np.full(96, 0.8), 0.6 * np.sin(angles)], axis=1)
    fan = [[96, k, (k + 1) % 96] for k in range(96)]
    source = ls.Mesh(np.concatenate([rim, [[0.0, 0.8, 0.0]]]), fan, material=diffuse(0.0, 2.0))
    truth = np.pi * 2.0 * 0.36 / (0.36 + 0.64)
    np.testing.assert_allclose(2.0 * abs(polygon_irradiance((0, 0, 0), (0, 1, 0), rim)), truth, rtol=2e-3)
    assert_is(found(source, strategy), 2.0 * abs(polygon_irradiance((0, 0, 0), (0, 1, 0), rim)))


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("place", [(0.0, 0.8, 0.0), (0.7, 0.9, -0.4)])
def test_path_traced_irradiance_of_a_disk_light_matches_lamberts_formula(
    place: tuple[float, float, float], strategy: str
) -> None:
    """Irradiance is L / 2 times Lambert's sum over a polygon of many corners, slanted to the floor."""
    light = ls.LightDisk(place, (-0.2, -1.0, 0.1), 0.35, intensity=2.0)
    u, v = (light.boundary()[k] - place for k in (0, 12))
    angle = 2.0 * np.pi * np.arange(1000)[:, None] / 1000
    rim = np.array(place) + np.cos(angle) * u + np.sin(angle) * v
    assert_is(found(light, strategy), 2.0 * abs(polygon_irradiance((0, 0, 0), (0, 1, 0), rim)))


@pytest.mark.parametrize(
    ("source", "strategy"), [("mesh", "hit"), ("mesh", "both"), *(("rect", strategy) for strategy in STRATEGIES)]
)
def test_path_traced_irradiance_of_a_rectangle_light_matches_lamberts_formula(source: str, strategy: str) -> None:
    """Irradiance is L / 2 times Lambert's sum over the edges of a slanted parallelogram."""
    corner, u, v = np.array([-0.2, 0.7, -0.6]), np.array([0.9, 0.4, 0.1]), np.array([0.1, 0.2, 0.8])
    light = ls.LightRect(corner + 0.5 * (u + v), u, v, intensity=2.0)
    seen = polygon_irradiance((0, 0, 0), (0, 1, 0), [corner, corner + u, corner + u + v, corner + v])
    assert_is(found(quad(corner, u, v, diffuse(0.0, 2.0)) if source == "mesh" else light, strategy), 2.0 * abs(seen))


@pytest.mark.parametrize(("half", "unit"), [(0.03, 1.0), (0.3, 1e3), (1.0, 1.0), (3.0, 1e-3), (3.0, 1.0), (30.0, 1e3)])
def test_path_traced_irradiance_of_a_sheared_emitter_matches_lamberts_formula(half: float, unit: float) -> None:
    """The emitter is a square that is rotated, stretched and sheared, far away, and moved since the last frame.

    Shadow rays end in front of the emitter, from any offset above a floor of any size.
    """
    corner, u, v = unit * np.array([[-0.2, 0.7, -0.6], [0.9, 0.4, 0.1], [0.1, 0.2, 0.8]])
    seen = polygon_irradiance((0, 0, 0), (0, 1, 0), [corner, corner + u, corner + u + v, corner + v])
    square = quad((0, 0, 0), (1, 0, 0), (0, 0, 1), diffuse(0.0, 2.0))
    transform, away = np.eye(4), unit * np.array([200.0, -50.0, 70.0])
    transform[:3] = np.stack([u, 3.0 / unit * np.cross(u, v), v, corner + away], axis=1)
    eye = away + unit * np.array([0, 0.3, 0.002])
    camera = ls.Camera.look_at(eye, away, (0, 0, -1), width=32, height=24, fov_y=0.002)
    side = 2.0 * unit * half
    floor = quad(away - (0.5 * side, 0, 0.5 * side), (0, 0, side), (side, 0, 0), diffuse(ALBEDO))
    scenes = [
        ls.Scene(meshes=[floor, ls.MeshInstance(square, matrix)])
        for matrix in (np.diag([unit, unit, unit, 1.0]), transform)
    ]
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=256, max_bounces=0)
    renderer = ls.create_renderer(config, "cpu")
    frames = [renderer.render(scene, camera) for scene in scenes]
    assert frames[0].color.max() < 1e-6
    assert_is(irradiance(frames[1], ALBEDO), 2.0 * abs(seen))


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("slope", [0.0, 0.7, np.pi / 2])
def test_path_traced_environment_irradiance_on_a_tilted_wall_is_exact(slope: float, strategy: str) -> None:
    """Irradiance is pi L (1 + cos) / 2: half of the environment is bright; the environment is tilted, not the wall."""
    above = np.repeat((np.arange(256) < 128)[:, None, None], 512, axis=1) * np.full(3, 2.0, np.float32)
    environment = ls.LightEnvironment(above, rotation_wxyz=(np.cos(0.5 * slope), 0.0, 0.0, np.sin(0.5 * slope)))
    assert_is(found(environment, strategy), np.pi * 2.0 * 0.5 * (1.0 + np.cos(slope)))


def test_path_traced_irradiance_of_a_point_light_is_exact_and_noise_free() -> None:
    """Irradiance is I cos / d^2 for intensity I and distance d."""
    position = np.array([0.9, 1.2, -0.5])
    distance = np.linalg.norm(position)
    values = found(ls.LightPoint(position, intensity=3.0), "sampled", samples=1)
    np.testing.assert_allclose(values, 3.0 * position[1] / distance**3, rtol=2e-3)


# --- Veach's plates ---

ROUGHNESS = (0.2, 0.35, 0.5, 0.7)
LIGHTS = (ls.LightSphere((-0.35, 1.5, -1.5), 0.25, intensity=7.0), ls.LightSphere((0.8, 1.6, -1.4), 0.7, intensity=1.0))
SIDE = ls.Camera.look_at((0, 0.35, 0.35), (0, 0, 0), width=32, height=24, fov_y=0.002)


class Estimate(NamedTuple):
    """Mean and standard error of a plate's radiance."""

    values: np.ndarray  # (H, W), independent, with one expectation
    mean: float
    error: float  # of the mean
    samples: int


def plate(roughness: float) -> ls.Mesh:
    """Returns a plate of rough metal."""
    return parallelogram((-3, 0, 3), (6, 0, 0), (0, 0, -6), metal(roughness))


def veach(roughness: float, strategy: str) -> Estimate:
    """Returns the radiance of a plate below both lights; BSDF sampling uses more samples."""
    lights = [replace(source, visible=strategy != "sampled") for source in LIGHTS]
    meshes = [plate(roughness), PANE] if strategy == "hit" else [plate(roughness)]
    samples, bounces = (256, 1) if strategy == "hit" else (64, 0)
    values = paths(ls.Scene(meshes=meshes, lights=lights), SIDE, samples, bounces).color[..., 1].astype(np.float64)
    return Estimate(values, float(values.mean()), float(values.std() / np.sqrt(values.size)), samples)


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_light_sampling_and_bsdf_sampling_give_equal_means_on_veachs_plates(roughness: float) -> None:
    """Means agree within four standard errors; the combination is about as precise as the better strategy."""
    sampled, hit, both = (veach(roughness, strategy) for strategy in STRATEGIES)
    assert all(found.error < 0.01 * found.mean for found in (sampled, hit, both))
    for a, b in ((sampled, hit), (sampled, both), (hit, both)):
        assert abs(a.mean - b.mean) < 4.0 * np.hypot(a.error, b.error)
    assert both.error < 1.5 * min(sampled.error, hit.error * np.sqrt(hit.samples / both.samples))


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_each_sampling_strategy_on_a_plate_of_veachs_scene_equals_quadrature(strategy: str) -> None:
    """Each strategy equals the integral over the lights' cones in float64."""
    view = np.array([0.0, 1.0, 1.0]) / np.sqrt(2.0)
    truth = sum(reflected_light(source, view, 0.35) for source in LIGHTS)
    assert_is(veach(0.35, strategy).values, truth)


def reflected_light(source: ls.LightSphere, view: np.ndarray, roughness: float) -> float:
    """Returns the radiance towards ``view`` of white metal below a sphere light, by quadrature over the light."""
    distance = np.linalg.norm(source.position)
    axis = np.asarray(source.position) / distance
    edge = 1.0 - np.sqrt(1.0 - (source.radius / distance) ** 2)
    lift, azimuth = np.meshgrid(edge * (np.arange(400) + 0.5) / 400, 2.0 * np.pi * (np.arange(400) + 0.5) / 400)
    across = np.cross(axis, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    sine = np.sqrt(lift * (2.0 - lift))[..., None]
    around = np.cos(azimuth)[..., None] * across + np.sin(azimuth)[..., None] * np.cross(axis, across)
    rays = (1.0 - lift)[..., None] * axis + sine * around
    white = {"alpha": roughness**2, "specular": [1.0], "grazing": 1.0}
    values = pbr_specular(white, np.array([0.0, 1.0, 0.0]), view, rays)[..., 0] * rays[..., 1]
    return float(2.0 * np.pi * edge * source.intensity * values.mean())


@pytest.mark.parametrize("setting", ["transmittance_threshold", "color_strength"])
@pytest.mark.parametrize("source", ["rect", "mesh", "sky"])
def test_shadow_threshold_and_tint_have_equal_effect_on_light_and_bsdf_sampling(source: str, setting: str) -> None:
    """A visible light has the shadow through haze of an invisible light, which only light sampling can reach."""
    rotation = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
    sheet = wide_sheet(1.0, 0.5, 0.0).gaussians
    sheet = replace(sheet, sh=np.full((1, 1, 3), -1.0) * [1.0, 0.2, -1.0])
    haze = ls.SplatInstance(sheet, rotation, material=diffuse(1.0))
    floor = quad((-4, 0, -4), (0, 0, 8), (8, 0, 0), metal(roughness=0.4))
    light = ls.LightRect((0, 2, 0), (3, 0, 0), (0, 0, 3), intensity=1.0)
    scene = ls.Scene(meshes=[floor], splats=[haze], lights=[replace(light, visible=False)])
    shown = replace(scene, lights=[light])
    if source == "mesh":
        shown = replace(
            scene, meshes=[floor, quad((-1.5, 2, -1.5), (3, 0, 0), (0, 0, 3), diffuse(0.0, 1.0))], lights=[]
        )
    if source == "sky":
        environment = ls.LightEnvironment(color=(0.7, 0.7, 0.7))
        shown, scene = (
            replace(scene, lights=[environment]),
            replace(scene, lights=[replace(environment, shadow_distance=1e6)]),
        )
    changed = replace(ls.ShadowConfig(), **{setting: 0.4 if setting == "transmittance_threshold" else 3.0})
    down = ls.Camera.look_at((0, 0.5, 0.3), (0, 0, 0), (0, 0, 1), width=16, height=12, fov_y=0.02)
    means = [paths(one, down, 64, 0, background=None, shadow_rays=changed).color.mean((0, 1)) for one in (scene, shown)]
    assert means[0].min() > 0.01
    np.testing.assert_allclose(means[1], means[0], rtol=0.04)
