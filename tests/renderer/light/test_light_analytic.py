"""Lighting compared with closed forms, and with float64 integrals where there are none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.compare.images import assert_close
from support.scenes.light_rig import (
    PIPELINES,
    above,
    assert_relatively_close,
    floor,
    floor_points,
    lit,
    tile_means,
    towards,
)
from support.scenes.light_scenes import ball_at, clear_glass, matte, metal

EVEN = ls.LightEnvironment(color=(0.5, 1.0, 1.5))
"""Constant environment."""

# --- How bright ---


@PIPELINES
@pytest.mark.parametrize("reach", [math.inf, 2.6], ids=["no range", "range"])
def test_plane_under_a_point_light_matches_the_inverse_square_law_and_gltf_window(
    pipeline: ls.Pipeline, reach: float
) -> None:
    """Every pixel is albedo / pi * candela / distance^2 * cosine, times glTF's range window."""
    light = ls.LightPoint((0.4, 1.5, -0.3), color=(1.0, 0.5, 0.2), intensity=7.0, range=reach)
    camera, albedo = above(), (0.9, 0.6, 0.3)
    frame = lit(ls.Scene((), [floor(matte(*albedo))], [light]), camera, pipeline)
    directions, distances = towards(light.position, floor_points(camera))
    irradiance = 7.0 / distances**2 * directions[..., 1] * np.clip(1.0 - (distances / reach) ** 4, 0.0, 1.0)
    expected = irradiance[..., None] / np.pi * np.array(albedo) * light.color
    if math.isfinite(reach):
        assert (expected == 0.0).any()
        assert (expected > 0.0).any()
    assert_relatively_close(frame.color, expected, 1e-4)


@PIPELINES
def test_plane_under_a_spot_light_matches_the_gltf_cone_falloff(pipeline: ls.Pipeline) -> None:
    """Light is full inside the inner cone, zero outside the outer cone, and glTF's squared ramp between."""
    light = ls.LightSpot((-0.5, 2.0, 0.4), (0.3, -1.0, -0.2), intensity=9.0, inner_angle=0.25, outer_angle=0.5)
    camera = above()
    frame = lit(ls.Scene((), [floor(matte(0.8))], [light]), camera, pipeline)
    directions, distances = towards(light.position, floor_points(camera))
    axis = np.array([0.3, -1.0, -0.2]) / np.linalg.norm([0.3, -1.0, -0.2])
    inner, outer = math.cos(0.25), math.cos(0.5)
    cone = np.clip((-directions @ axis - outer) / (inner - outer), 0.0, 1.0) ** 2
    assert (cone == 1.0).any()
    assert (cone == 0.0).any()
    expected = 0.8 / np.pi * 9.0 / distances**2 * directions[..., 1] * cone
    assert_relatively_close(frame.color, np.repeat(expected[..., None], 3, axis=2), 1e-4)


@PIPELINES
@pytest.mark.parametrize("shadows", ls.Shadows, ids=lambda shadows: shadows.value)
def test_unblocked_light_of_each_type_is_equally_bright_with_hard_soft_and_no_shadows(
    pipeline: ls.Pipeline, shadows: ls.Shadows
) -> None:
    """Spheres and distant discs above the horizon light like points at their centres; sampling adds only noise."""
    lights = [
        ls.LightPoint((0.4, 1.5, -0.3), intensity=7.0, radius=0.3),
        ls.LightSphere((-1.0, 2.0, 0.5), 0.4, intensity=6.0),
        ls.LightDirectional((0.3, -1.0, 0.2), intensity=2.0, angle=0.15),
    ]
    camera = above()
    samples = 64 if shadows is ls.Shadows.SOFT else 1
    settings = {"shadows": shadows, "samples": samples, "jitter": False}
    frame = lit(ls.Scene((), [floor(matte(0.8))], lights), camera, pipeline, aovs=("lights",), **settings)
    points = floor_points(camera)
    expected = []
    for light, candela in zip(lights[:2], (7.0, 6.0 * math.pi * 0.4**2), strict=True):
        directions, distances = towards(light.position, points)
        expected.append(candela / distances**2 * directions[..., 1])
    expected.append(np.full(points.shape[:2], -2.0 * lights[2].direction[1]))
    assert frame.light_direct is not None
    for k, irradiance in enumerate(expected):
        radiance = 0.8 / np.pi * irradiance
        ours = frame.light_direct[k].mean(axis=2)
        if shadows is ls.Shadows.SOFT:
            assert np.abs(ours / radiance - 1.0).max() < 0.12
            assert np.mean(ours) == pytest.approx(np.mean(radiance), rel=2e-3)
        else:
            assert_relatively_close(ours, radiance, 1e-4)


@PIPELINES
def test_lit_frame_is_the_sum_over_lights_of_unshadowed_light_times_shadow_factor(pipeline: ls.Pipeline) -> None:
    """A disabled light adds nothing."""
    lights = [
        ls.LightPoint((0.4, 1.5, -0.3), color=(1.0, 0.2, 0.1), intensity=7.0, name="lamp"),
        ls.LightDirectional((0.4, -1.0, 0.3), intensity=1.5, casts_shadow=False),
        ls.LightSpot((-1.0, 2.0, 0.0), (0.3, -1.0, 0.0), color=(0.1, 0.9, 0.4), intensity=5.0),
    ]
    off = ls.LightPoint((0.0, 1.0, 0.0), intensity=100.0, enabled=False)
    meshes = [floor(matte(0.7, 0.8, 0.9)), ball_at((0.1, 0.6, 0.0), 0.3, matte(0.5))]
    camera = above()
    frame = lit(ls.Scene((), meshes, [*lights, off]), camera, pipeline, aovs=("lights",))
    single = [lit(ls.Scene((), meshes, [light]), camera, pipeline, aovs=("lights",)) for light in lights]
    assert frame.light_direct is not None
    assert frame.light_shadow is not None
    assert_close(frame.color, np.sum([one.color for one in single], axis=0), atol=1e-5)
    assert_close(frame.color, (frame.light_direct * frame.light_shadow).sum(axis=0), atol=1e-5)
    assert (frame.light_shadow[0] == 0.0).any()
    assert (frame.light_shadow[1] == 1.0).all()
    enabled = [k for k in range(len(frame.light_direct)) if frame.light_direct[k].any()]
    assert len(enabled) == 3
    for k, one in zip(enabled, single, strict=True):
        assert one.light_direct is not None
        assert_close(frame.light_direct[k], one.light_direct[0], atol=1e-6)


@PIPELINES
def test_scene_without_lights_is_lit_by_a_headlight_at_the_camera(pipeline: ls.Pipeline) -> None:
    """A white wall that faces the camera has brightness 1 at any distance; tilted walls are darker by their cosine."""
    camera = above(height=3.0, eye=(1.5, 0.4))
    frame = lit(ls.Scene((), [floor(matte(0.9))]), camera, pipeline)
    directions, _ = towards(tuple(camera.eye), floor_points(camera))
    assert_relatively_close(frame.color, np.repeat(0.9 * directions[..., 1:2], 3, axis=2), 1e-4)


RECT = ls.LightRect((0.3, 1.2, -0.2), (1.1, 0.2, 0.0), (0.1, 0.0, 0.9), intensity=3.0)
"""Rectangle light over the plane, facing down and slightly to one side."""


def rect_irradiance(light: ls.LightRect, points: np.ndarray) -> np.ndarray:
    """Returns the irradiance on a plane that faces up, the rectangle above its horizon (Lambert 1760), shape (H, W)."""
    u, v = 0.5 * np.array(light.edge_u), 0.5 * np.array(light.edge_v)
    corners = [np.array(light.position) + a * u + b * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    rays = [towards(corner, points)[0] for corner in corners]
    total = np.zeros(points.shape[:2])
    for first, second in zip(rays, rays[1:] + rays[:1], strict=True):
        across = np.cross(first, second)
        sine = np.linalg.norm(across, axis=-1)
        total += np.arctan2(sine, (first * second).sum(axis=-1)) / sine * across[..., 1]
    return 0.5 * light.intensity * np.maximum(-total, 0.0)


def test_plane_under_a_rectangle_light_matches_the_closed_form() -> None:
    """With soft shadows, the closed form integrates the rectangle; with hard shadows, it uses a point at the centre."""
    camera = above()
    scene = ls.Scene((), [floor(matte(0.8))], [RECT])
    points = floor_points(camera)
    directions, distances = towards(RECT.position, points)
    normal = np.cross(RECT.edge_u, RECT.edge_v)
    as_point = 3.0 * -(directions @ normal) * directions[..., 1] / distances**2
    expected = 0.8 / np.pi * as_point
    assert_relatively_close(lit(scene, camera, shadows=ls.Shadows.HARD).color[..., 0], expected, 1e-4)
    expected = 0.8 / np.pi * rect_irradiance(RECT, points)
    assert np.abs(as_point * 0.8 / np.pi / expected - 1.0).max() > 0.1
    ours = lit(scene, camera, shadows=ls.Shadows.SOFT, samples=128).color[..., 0]
    assert np.mean(ours) == pytest.approx(np.mean(expected), rel=2e-3)
    assert np.abs(tile_means(ours) / tile_means(expected) - 1.0).max() < 0.02


def test_plane_under_a_disk_light_matches_the_closed_form() -> None:
    """With soft shadows, the closed form is that of a parallel disk; with hard ones, a point at the disk's centre."""
    camera, disk = above(), ls.LightDisk((0.3, 1.2, -0.2), (0.0, -1.0, 0.0), 0.5, intensity=3.0)
    scene, points = ls.Scene((), [floor(matte(0.8))], [disk]), floor_points(camera)
    directions, distances = towards(disk.position, points)
    as_point = 3.0 * np.pi * 0.25 * directions[..., 1] ** 2 / distances**2
    hard = lit(scene, camera, shadows=ls.Shadows.HARD).color[..., 0]
    assert_relatively_close(hard, 0.8 / np.pi * as_point, 1e-4)
    height2 = (distances * directions[..., 1]) ** 2
    aside2 = distances**2 - height2
    total = height2 + aside2 + 0.25
    factor = 0.5 * (1.0 - (total - 0.5) / np.sqrt(total**2 - aside2))
    expected = 0.8 * 3.0 * factor
    ours = lit(scene, camera, shadows=ls.Shadows.SOFT, samples=128).color[..., 0]
    assert np.mean(ours) == pytest.approx(np.mean(expected), rel=2e-3)
    assert np.abs(tile_means(ours) / tile_means(expected) - 1.0).max() < 0.02


# --- Materials under a point light and in a constant environment ---


def schlick(material: ls.MaterialPbr, cosine: np.ndarray) -> np.ndarray:
    """Returns the Schlick reflectance of a facet, shape (..., 3)."""
    metallic, cosine = material.mesh_metallic, cosine[..., None]
    straight = material.specular * ((material.ior - 1.0) / (material.ior + 1.0)) ** 2 * (1.0 - metallic)
    straight = straight + metallic * np.array(material.mesh_color)
    grazing = material.specular * (1.0 - metallic) + metallic
    return straight + (grazing - straight) * (1.0 - cosine) ** 5


def smith_g1(alpha: float, cosine: np.ndarray) -> np.ndarray:
    """Returns Smith's masking of GGX: the visible fraction of the facets that face a direction."""
    return 2.0 * cosine / (cosine + np.sqrt(alpha**2 + (1.0 - alpha**2) * cosine**2))


def highlight_albedo(material: ls.MaterialPbr, cosines: np.ndarray, steps: int = 256) -> np.ndarray:
    """Returns the directional albedo of the highlight at the viewers' cosines, shape (..., 3), by quadrature.

    Integrates over the facets visible to each viewer (Heitz 2018), on a grid of ``steps`` by ``steps`` numbers.
    """
    alpha = material.mesh_roughness**2
    out, turn = np.meshgrid((np.arange(steps) + 0.5) / steps, (np.arange(steps) + 0.5) / steps * 2.0 * np.pi)
    shares = []
    for cosine in np.ravel(cosines):
        sine = math.sqrt(1.0 - cosine**2)
        stretched = np.array([alpha * sine, 0.0, cosine]) / math.hypot(alpha * sine, cosine)
        x, y = np.sqrt(out) * np.cos(turn), np.sqrt(out) * np.sin(turn)
        s = 0.5 * (1.0 + stretched[2])
        y = (1.0 - s) * np.sqrt(1.0 - x * x) + s * y
        z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
        # The tangents of the stretched view are the y axis and the vector perpendicular to both.
        facet = x[..., None] * [0.0, 1.0, 0.0] + y[..., None] * [-stretched[2], 0.0, stretched[0]]
        facet = (facet + z[..., None] * stretched) * [alpha, alpha, 1.0]
        facet /= np.linalg.norm(facet, axis=-1, keepdims=True)
        tilt = facet @ [sine, 0.0, cosine]
        light = 2.0 * tilt * facet[..., 2] - cosine
        seen = np.where(light > 0.0, smith_g1(alpha, np.maximum(light, 1e-9)), 0.0)
        shares.append((schlick(material, tilt) * seen[..., None]).mean(axis=(0, 1)))
    return np.reshape(shares, (*np.shape(cosines), 3))


def pbr(material: ls.MaterialPbr, normal: np.ndarray, view: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Returns the BSDF of a rough material, without cosine, shape (..., 3); directions point away from the surface.

    The diffuse part gets the energy that the highlight leaves, on the way in and out (Kelemen and Szirmay-Kalos 2001).
    """
    alpha = material.mesh_roughness**2
    half = view + light
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    facing, shone, tilt = ((normal * b).sum(-1) for b in (view, light, half))
    spread = alpha**2 / (np.pi * (tilt**2 * (alpha**2 - 1.0) + 1.0) ** 2)
    value = spread * smith_g1(alpha, facing) * smith_g1(alpha, shone) / (4.0 * facing * shone)
    value = schlick(material, (view * half).sum(-1)) * value[..., None]
    nodes = (np.arange(64) + 0.5) / 64
    left = 1.0 - highlight_albedo(replace(material, metallic=0.0), nodes, 96)  # metal has no diffuse part
    mean = (2.0 * nodes[:, None] * left).mean(axis=0)
    enters, leaves = (
        np.stack([np.interp(cosine, nodes, left[:, c]) for c in range(3)], axis=-1) for cosine in (shone, facing)
    )
    return value + diffuse_color(material) / np.pi * enters * leaves / mean


def diffuse_color(material: ls.MaterialPbr) -> np.ndarray:
    """Returns the albedo below the highlight, shape (3,); rough surfaces scatter the transmitted fraction."""
    return (1.0 - material.mesh_metallic) * np.array(material.mesh_color)


MATERIALS = {
    "default": (ls.MaterialPbr(), 0.01),
    "plastic": (ls.MaterialPbr(base_color=(0.9, 0.1, 0.3), roughness=0.25), 0.03),
    "dull": (ls.MaterialPbr(base_color=(0.9, 0.6, 0.3), roughness=0.9, specular=0.4, ior=1.8), 0.01),
    "gold": (ls.MaterialPbr(base_color=(1.0, 0.75, 0.3), roughness=0.4, metallic=1.0), 0.0),
    "half a metal": (ls.MaterialPbr(base_color=(0.5, 0.75, 0.9), roughness=0.6, metallic=0.5), 0.03),
    "frosted": (ls.MaterialPbr(base_color=(0.5, 0.75, 0.9), roughness=0.5, transmission=0.6), 0.01),
}
"""Materials, and how much darker than the integrals a frame may be.

The energy left by highlights is taken from fitted curves that rather underestimate it."""


@PIPELINES
@pytest.mark.parametrize("name", MATERIALS)
def test_plane_under_a_point_light_matches_the_formula_of_each_material(name: str, pipeline: ls.Pipeline) -> None:
    """The formula of each material includes its highlight."""
    (material, loss), camera = MATERIALS[name], above(eye=(2.5, 1.0), height=2.5)
    light = ls.LightPoint((-1.2, 1.4, -0.4), intensity=7.0)
    frame = lit(ls.Scene((), [floor(material)], [light]), camera, pipeline)
    points = floor_points(camera)
    view, _ = towards(tuple(camera.eye), points)
    directions, distances = towards(light.position, points)
    irradiance = 7.0 / distances**2 * directions[..., 1]
    expected = pbr(material, np.array([0.0, 1.0, 0.0]), view, directions) * irradiance[..., None]
    rounding = 1e-3 * expected.max()
    assert (frame.color < expected + rounding).all()
    assert (frame.color > (1.0 - loss) * expected - rounding).all()


@PIPELINES
def test_emission_and_ambient_light_of_a_simple_material_are_added_once_per_frame(pipeline: ls.Pipeline) -> None:
    """Diffuse reflection and Phong highlight are added for each light."""
    material = ls.MaterialSimple(
        base_color=(0.9, 0.7, 0.5),
        emissive=(0.1, 0.0, 0.2),
        ambient=(0.05, 0.1, 0.0),
        diffuse=(0.5, 0.6, 0.1),
        specular=(0.3, 0.2, 0.4),
        shininess=24.0,
    )
    camera = above(eye=(2.5, 1.0), height=2.5)
    lights = [ls.LightPoint((-1.2, 1.4, -0.4), intensity=7.0), ls.LightPoint((0.5, 2.0, 0.4), intensity=3.0)]
    frame = lit(ls.Scene((), [floor(material)], lights), camera, pipeline)
    points = floor_points(camera)
    view, _ = towards(tuple(camera.eye), points)
    mirrored = view * (-1.0, 1.0, -1.0)
    base = np.array(material.mesh_color)
    expected = base * (np.array(material.emissive) + material.ambient) + np.zeros(points.shape)
    for light in lights:
        directions, distances = towards(light.position, points)
        highlight = 26.0 / (2.0 * np.pi) * np.maximum((mirrored * directions).sum(-1), 0.0) ** 24
        bsdf = base * material.diffuse / np.pi + np.array(material.specular) * highlight[..., None]
        expected += bsdf * (light.intensity / distances**2 * directions[..., 1])[..., None]
    assert_relatively_close(frame.color, expected, 1e-3)


@pytest.mark.parametrize("name", MATERIALS)
def test_plane_in_a_constant_environment_shows_the_albedo_of_each_material(name: str) -> None:
    """A plane shows the highlight's directional albedo at each angle, and the diffuse colour times the rest."""
    material, loss = MATERIALS[name]
    camera = ls.Camera.look_at((3.0, 2.0, 0.0), (0.0, 0.0, 0.0), width=32, height=48, fov_y=0.7)
    frame = lit(ls.Scene((), [floor(material)], [EVEN]), camera, shadows=ls.Shadows.SOFT, samples=96)
    cosines = towards(tuple(camera.eye), floor_points(camera))[0][..., 1]
    rows = np.arange(0, 48, 6)
    means = np.array([cosines[row : row + 6].mean() for row in rows])
    mirrored = highlight_albedo(material, means)
    reflected = highlight_albedo(replace(material, metallic=0.0), means)
    expected = (mirrored + diffuse_color(material) * (1.0 - reflected)) * EVEN.color
    ours = np.array([frame.color[row : row + 6].mean(axis=(0, 1)) for row in rows])
    assert (expected < EVEN.color).all()
    noise = 0.015
    assert (ours < (1.0 + noise) * expected).all()
    assert (ours > (1.0 - loss - noise) * expected).all()


@PIPELINES
def test_diffuse_plane_in_a_constant_environment_shows_albedo_times_radiance(pipeline: ls.Pipeline) -> None:
    """Each channel of the plane is albedo times radiance."""
    camera, albedo = above(), np.array([0.9, 0.5, 0.2])
    frame = lit(ls.Scene((), [floor(matte(*albedo))], [EVEN]), camera, pipeline, shadows=ls.Shadows.SOFT, samples=64)
    means = [tile_means(frame.color[..., c]) for c in range(3)]
    np.testing.assert_allclose(np.stack(means, -1), np.broadcast_to(albedo * EVEN.color, (6, 8, 3)), rtol=0.03)
    np.testing.assert_allclose(frame.color.mean(axis=(0, 1)), albedo * EVEN.color, rtol=3e-3)


FURNACE = {
    "white": (matte(1.0), 0.004),
    "mirror": (metal(0.0), 1e-4),
    "glass": (clear_glass(), 0.01),
    "polished": (metal(0.15), 0.01),
    "enamel": (ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.0, ior=2.0), 0.004),
    "half a mirror": (ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.0, metallic=0.5), 0.004),
    "white, seen": (replace(matte(1.0), specular=0.0, ior=1.0), 0.004),
}
"""Materials that lose no energy, with the tolerance of the mean brightness."""


@pytest.mark.parametrize("name", FURNACE)
def test_convex_objects_that_absorb_no_light_are_invisible_in_a_white_furnace(name: str) -> None:
    """A convex object of a lossless material cannot be distinguished from the constant environment."""
    material, off = FURNACE[name]
    camera = ls.Camera.look_at((1.5, 1.0, 2.6), (0.0, 0.0, 0.0), width=48, height=48, fov_y=0.6)
    scene = ls.Scene((), [ball_at((0.0, 0.0, 0.0), 0.7, material)], [EVEN])
    samples = 2 if name in ("mirror", "glass") else 96  # mirrors and glass have no noise
    frame = lit(scene, camera, shadows=ls.Shadows.SOFT, samples=samples, max_bounces=16)
    inside = frame.instance_index == 0
    assert 0.3 < inside.mean() < 0.9
    np.testing.assert_allclose(frame.color[~inside].mean(axis=0), EVEN.color, rtol=1e-3)
    np.testing.assert_allclose(frame.color[inside].mean(axis=0), EVEN.color, rtol=off)
