"""Mirrors and glass among meshes, without Gaussians: geometry and energy compared with values calculated by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.demo import shapes
from lumisplat.math.color import encode_srgb
from support.kinds import present
from support.oracles.raster_oracle import normalized
from support.scenes.raster_scenes import quad, similarity
from support.scenes.ray_rig import RayRig
from support.scenes.trace_scenes import GLASS, MIRROR, slab

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
WHITE = (1.0, 1.0, 1.0)
LIGHT = ls.MaterialPbr(base_color=WHITE)
FORWARD = np.array([[0.0, 0.0, 1.0]])
ORIGIN = np.zeros((1, 3))
SCALES = [(1e-3, 0.0), (1.0, 0.0), (1e3, 0.0), (1.0, 1e3)]
"""Scale of a scene, and its distance from the world's origin in scales."""


@pytest.fixture(params=DEVICES)
def rig(request: pytest.FixtureRequest) -> RayRig:
    """Returns a rig that traces rays on each device in turn."""
    return RayRig(request.param)


def cube(material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a cube of twelve triangles around the origin, from -1 to 1."""
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return ls.Mesh(corners, np.array(faces), material=material)


def ball(material: ls.MaterialPbr, subdivisions: int = 4) -> ls.Mesh:
    """Returns a sphere with smooth normals."""
    return replace(shapes.icosphere(subdivisions=subdivisions), material=material)


def shape(name: str, material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a closed convex mesh of size 1; one of the shapes has needles at its poles."""
    if name == "cube":
        return cube(material)
    if name == "needles":
        return replace(shapes.superellipsoid(rows=6, columns=800), normals=None, material=material)
    return replace(ball(material), normals=None)


def transform_of(scale: float, offset: float) -> np.ndarray:
    """Returns a transform with a rotation, a scale, and an offset in units of the scale."""
    return similarity((1.0, 2.0, 0.5), 0.9, scale, (0.8 * offset * scale, -0.6 * offset * scale, 0.0))


def moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Returns the points transformed by the matrix."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def aims(rng: np.random.Generator, mesh: ls.Mesh, count: int) -> np.ndarray:
    """Returns points on a mesh, half of them on edges."""
    weights = rng.dirichlet((1.0, 1.0, 1.0), count)
    weights[::2, 0] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    faces = mesh.indices[rng.integers(0, mesh.face_count, count)]
    return np.einsum("nk,nkc->nc", weights, mesh.positions[faces].astype(float))


# --- Colours ---


def test_rays_that_hit_a_rough_mesh_show_its_base_colour_and_spawn_no_reflected_rays(rig: RayRig) -> None:
    """One wave of rays is traced; rays that miss the mesh return the background."""
    grey = ls.MaterialPbr(base_color=(0.5, 0.25, 0.1), metallic=1.0, transmission=1.0)
    along = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    seen = rig.colors(ls.Scene([], [quad(2.0, material=grey)]), np.zeros((2, 3)), along, background=(0.1, 0.2, 0.3))
    shown = encode_srgb([0.5, 0.25, 0.1])
    np.testing.assert_allclose(seen, np.stack([shown, [0.1, 0.2, 0.3]]), atol=1e-5)
    assert len(rig.waves) == 1


def test_rays_through_a_scene_without_meshes_return_the_background(rig: RayRig) -> None:
    """A pixel without a ray returns the background, too."""
    seen = rig.colors(ls.Scene(), np.zeros((2, 3)), np.eye(3)[:2], background=WHITE, t_max=np.array([np.inf, 0.0]))
    np.testing.assert_array_equal(seen, [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])


def test_mirror_tilted_by_45_degrees_turns_rays_by_90_degrees(rig: RayRig) -> None:
    """The reflected ray has the expected origin and direction, and the result is tinted by the mirror."""
    gold = replace(MIRROR, base_color=(1.0, 0.7, 0.3))
    scene = ls.Scene([], [quad(2.0, tilt=1.0, material=gold)])
    seen = rig.colors(scene, [[0.25, 0.1, 0.0]], FORWARD, background=(0.5, 0.5, 0.5))
    reflected = rig.waves[1]
    np.testing.assert_allclose(reflected.direction, [[1.0, 0.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(reflected.origin, [[0.25, 0.1, 2.25]], atol=1e-5)
    np.testing.assert_allclose(reflected.path_length, [2.25], rtol=1e-6)
    base = np.array([1.0, 0.7, 0.3])
    head_on = base + (1.0 - base) * (1.0 - np.sqrt(0.5)) ** 5
    np.testing.assert_allclose(seen[0], 0.5 * encode_srgb(head_on), atol=1e-5)


def test_reflected_rays_store_the_length_of_the_path_from_the_camera(rig: RayRig) -> None:
    """After any number of reflections, the stored length equals the path to the virtual eye behind all mirrors."""
    scene = ls.Scene([], [quad(2.0, 20.0, material=MIRROR), quad(-1.0, 20.0, material=MIRROR)])
    along = normalized(np.array([[0.3, 0.1, 1.0]]))
    rig.colors(scene, ORIGIN, along, bounces=5)
    lengths = np.array([2.0, 5.0, 8.0, 11.0, 14.0]) / along[0, 2]
    for wave, length in zip(rig.waves[1:], lengths, strict=True):
        assert wave.path_length[0] == pytest.approx(length, rel=1e-5)
        np.testing.assert_allclose(wave.origin[0, :2], along[0, :2] * length, atol=3e-5)


@pytest.mark.parametrize("bounces", [0, 1, 2, 7])
def test_max_bounces_limits_the_reflections_between_two_mirrors(rig: RayRig, bounces: int) -> None:
    """Rays after the last bounce see the background; rays that leave the mirrors start no further wave."""
    scene = ls.Scene([], [quad(2.0, 20.0, material=MIRROR), quad(-1.0, 20.0, material=MIRROR)])
    seen = rig.colors(scene, ORIGIN, FORWARD, bounces=bounces, background=WHITE)
    np.testing.assert_allclose(seen, 1.0, atol=1e-5)
    assert len(rig.waves) == 1 + bounces
    alone = ls.Scene([], [quad(2.0, material=MIRROR)])
    seen = rig.colors(alone, ORIGIN, FORWARD, bounces=bounces, background=WHITE)
    np.testing.assert_allclose(seen, 1.0, atol=1e-5)
    assert len(rig.waves) == 1 + min(bounces, 1)


def test_glass_slab_shifts_rays_by_snells_law(rig: RayRig) -> None:
    """The shift is d sin(a) (1 - cos(a) / (n cos(b))) for thickness d, index n, and angles a outside and b inside."""
    angle, ior, thickness = np.radians(50.0), 1.5, 0.3
    along = np.array([[np.sin(angle), 0.0, np.cos(angle)]])
    rig.colors(ls.Scene([], [slab(1.0, thickness, GLASS)]), ORIGIN, along, bounces=2)
    leaving = np.flatnonzero(rig.waves[2].direction[:, 2] > 0.0)[0]
    beyond = np.arcsin(np.sin(angle) / ior)
    inside = rig.waves[1].direction[rig.waves[1].direction[:, 2] > 0.0][0]
    np.testing.assert_allclose(inside, [np.sin(beyond), 0.0, np.cos(beyond)], atol=1e-6)
    np.testing.assert_allclose(rig.waves[2].direction[leaving], along[0], atol=1e-6)
    origin = rig.waves[2].origin[leaving]
    shift = np.linalg.norm(np.cross(origin, along[0]))
    expected = thickness * np.sin(angle) * (1.0 - np.cos(angle) / (ior * np.cos(beyond)))
    # The tolerance is the offset at which rays start from a surface a hundred units wide.
    assert shift == pytest.approx(expected, rel=3e-4)
    assert origin[2] == pytest.approx(1.0 + thickness, rel=3e-5)


def test_glass_slab_reflects_and_transmits_by_fresnels_equations(rig: RayRig) -> None:
    """At normal incidence each face reflects 4 %, tinted by each crossing; the second inner reflection sees white."""
    tint = np.array([0.8, 0.5, 0.2])
    glass = replace(GLASS, base_color=tuple(tint))
    seen = rig.colors(ls.Scene([], [slab(1.0, 0.3, glass)]), ORIGIN, FORWARD, bounces=9, background=WHITE)
    through = 0.96 * encode_srgb(tint)
    expected = 0.04 + through**2 + through * 0.04 * through + through * 0.04 * 0.04
    np.testing.assert_allclose(seen[0], expected, atol=1e-5)


def test_partly_transmitting_glass_adds_the_light_of_its_diffuse_base_colour(rig: RayRig) -> None:
    """The fraction that is neither reflected nor transmitted shows the base colour."""
    paint = ls.MaterialPbr(base_color=(0.5, 0.5, 0.5), roughness=0.0, transmission=0.25)
    scene = ls.Scene([], [quad(1.0, material=paint)])
    seen = rig.colors(scene, ORIGIN, FORWARD, bounces=0)
    np.testing.assert_allclose(seen[0], 0.96 * 0.75 * encode_srgb(np.full(3, 0.5)), atol=1e-5)


def test_light_in_a_45_degree_prism_is_totally_reflected(rig: RayRig) -> None:
    """All light arrives except the 4 % that each of two crossings reflects, and no ray passes straight through."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 1, 0], [1, 1, 0], [0, 1, 1]], dtype=float) - [0, 0.5, 0]
    faces = [[0, 1, 2], [3, 5, 4], [0, 3, 4], [0, 4, 1], [0, 2, 5], [0, 5, 3], [1, 4, 5], [1, 5, 2]]
    prism = ls.Mesh(corners, np.array(faces), material=GLASS)
    light = ls.Mesh([[-2, -1, -1], [-2, 1, -1], [-2, 1, 1], [-2, -1, 1]], [[0, 1, 2], [0, 2, 3]], material=LIGHT)
    seen = rig.colors(ls.Scene([], [prism, light]), [[0.4, 0.1, -2.0]], FORWARD, bounces=3)
    np.testing.assert_allclose(seen[0], np.full(3, 0.96**2), atol=1e-5)


def test_gaussians_are_blended_on_every_segment_of_a_mirror_or_glass_path(rig: RayRig) -> None:
    """Colour and transmittance of the Gaussians apply to the path before and after the mirror or glass."""
    rig.color, rig.transmittance = (0.1, 0.2, 0.3), 0.5
    haze, environment = np.array([0.1, 0.2, 0.3]), np.array([0.4, 0.6, 0.8])
    for material in (MIRROR, replace(GLASS, ior=1.0)):
        seen = rig.colors(ls.Scene([], [quad(2.0, material=material)]), ORIGIN, FORWARD, background=tuple(environment))
        np.testing.assert_allclose(seen[0], haze + 0.5 * (haze + 0.5 * environment), atol=1e-6)


def test_mirror_and_glass_rays_of_less_than_1_512_of_a_pixels_weight_are_not_traced() -> None:
    """A ray ends below 1/512 whether reflectance, tint or transmittance of Gaussians makes it faint."""
    head_on = ls.Scene([], [quad(2.0, material=ls.MaterialPbr(base_color=(0.0, 0.0, 0.0), roughness=0.0))])
    for specular, transmittance, waves in ((1.0, 1.0, 2), (0.05, 1.0, 2), (0.048, 1.0, 1), (1.0, 0.048, 1)):
        material = replace(head_on.meshes[0].mesh.material, specular=specular)
        rig = RayRig("cpu", transmittance=transmittance)
        rig.colors(ls.Scene([], [quad(2.0, material=material)]), ORIGIN, FORWARD)
        assert len(rig.waves) == waves, f"specular {specular}, transmittance {transmittance}"


def test_mirror_path_ends_when_the_product_of_reflectances_is_below_1_512(rig: RayRig) -> None:
    """Between two surfaces that reflect 19.75 %, the third reflection is traced, and the fourth is not."""
    dark = ls.MaterialPbr(base_color=(0.0, 0.0, 0.0), roughness=0.0, ior=2.6)
    corridor = ls.Scene([], [quad(2.0, material=dark), quad(-1.0, material=dark)])
    rig.colors(corridor, ORIGIN, FORWARD, bounces=9)
    assert len(rig.waves) == 1 + 3


def test_rays_that_glass_splits_off_a_camera_ray_have_different_random_keys(rig: RayRig) -> None:
    """No two rays that one camera ray splits into share random numbers."""
    rig.colors(ls.Scene([], [slab(1.0, 0.3, GLASS)]), ORIGIN, normalized(np.array([[0.5, 0.0, 1.0]])), bounces=4)
    sample_keys = np.concatenate([wave.sample_key for wave in rig.waves])
    assert len(np.unique(sample_keys)) == len(sample_keys) > 4


# --- Energy ---


@pytest.mark.parametrize(
    ("name", "ior", "specular", "lost"),
    [
        ("glass", 1.2, 1.0, 1e-3),
        ("glass", 1.5, 1.0, 3.0 / 512.0),
        ("glass", 1.5, 0.5, 1.0 / 512.0),
        ("diamond", 2.4, 1.0, 12.0 / 512.0),
        ("air", 1.0, 1.0, 1e-5),
    ],
)
def test_clear_glass_ball_is_invisible_in_a_white_furnace(
    rig: RayRig, name: str, ior: float, specular: float, lost: float
) -> None:
    """The ball is invisible except for rays too faint to trace."""
    rng = np.random.default_rng(1)
    across = rng.uniform(-0.6, 0.6, (4000, 2))
    material = replace(GLASS, ior=ior, specular=specular)
    origins = np.append(across, np.full((4000, 1), -5.0), axis=1)
    along = np.broadcast_to(FORWARD, (4000, 3))
    seen = rig.colors(ls.Scene([], [ball(material)]), origins, along, bounces=30, background=WHITE)
    assert seen.max() < 1.0 + 1e-5
    assert seen.min() > 1.0 - lost


def test_white_mirrors_are_invisible_in_a_white_furnace(rig: RayRig) -> None:
    """White mirrors reflect all light of a white environment in any orientation."""
    meshes = [
        ls.MeshInstance(ball(MIRROR, 2), similarity(offset=(x, y, 6.0), scale=0.6)) for x in (-1, 1) for y in (-1, 1)
    ]
    rng = np.random.default_rng(2)
    along = normalized(np.append(rng.uniform(-0.4, 0.4, (3000, 2)), np.ones((3000, 1)), axis=1))
    seen = rig.colors(ls.Scene([], meshes), np.zeros((3000, 3)), along, bounces=40, background=WHITE)
    np.testing.assert_allclose(seen, 1.0, atol=1e-4)


# --- Rays start where they should ---


@pytest.mark.parametrize(("scale", "offset"), SCALES)
@pytest.mark.parametrize("name", ["cube", "ball", "needles"])
def test_rays_reflected_by_a_convex_mirror_do_not_hit_it_again(
    rig: RayRig, name: str, scale: float, offset: float
) -> None:
    """Rays from outside, near and far, leave the mirror after one reflection."""
    mesh, matrix = shape(name, MIRROR), transform_of(scale, offset)
    rng = np.random.default_rng(3)
    inner = 0.9 * aims(rng, mesh, 8000)
    origins = moved(normalized(rng.normal(size=(8000, 3))) * rng.choice([3.0, 100.0], (8000, 1)), matrix)
    along = normalized(moved(inner, matrix) - origins.astype(np.float32))
    scene = ls.Scene([], [ls.MeshInstance(mesh, matrix)])
    rig.colors(scene, origins, along, bounces=1)
    reflected = rig.waves[1].t_max
    assert len(reflected) > 7900
    assert np.isinf(reflected).all(), f"{np.isfinite(reflected).sum()} reflections hit the mirror again"


@pytest.mark.parametrize("pose", [pytest.param("turned", marks=pytest.mark.deep), "sheared"])
@pytest.mark.parametrize(("scale", "offset"), SCALES)
@pytest.mark.parametrize("name", ["cube", "ball", "needles"])
def test_rays_inside_a_closed_mirror_stay_inside_for_six_reflections(
    rig: RayRig, name: str, scale: float, offset: float, pose: str
) -> None:
    """Rays from inside are aimed at faces, edges and corners of the mirror."""
    mesh, matrix = shape(name, MIRROR), transform_of(scale, offset)
    if pose == "sheared":
        matrix = (
            matrix @ similarity(scale=0.8) @ np.array([[1, 0.5, 0, 0], [0, 0.6, 0, 0], [0, 0, -1.2, 0], [0, 0, 0, 1]])
        )
    rng = np.random.default_rng(4)
    origins = moved(0.5 * normalized(rng.normal(size=(8000, 3))), matrix)
    along = normalized(moved(aims(rng, mesh, 8000), matrix) - origins.astype(np.float32))
    rig.colors(ls.Scene([], [ls.MeshInstance(mesh, matrix)]), origins, along, bounces=6)
    for number, wave in enumerate(rig.waves):
        assert np.isfinite(wave.t_max).all(), f"{np.isinf(wave.t_max).sum()} rays got out after {number} reflections"
    assert [len(wave.t_max) for wave in rig.waves] == [8000] * 7


@pytest.mark.parametrize(("scale", "offset"), SCALES)
@pytest.mark.parametrize("name", ["cube", "ball", "needles"])
def test_refracted_rays_skip_the_entered_surface_and_hit_the_opposite_one(
    rig: RayRig, name: str, scale: float, offset: float
) -> None:
    """Refracted rays cross the body from the surface that they entered to the opposite one."""
    mesh, matrix = shape(name, GLASS), transform_of(scale, offset)
    rng = np.random.default_rng(5)
    origins = moved(normalized(rng.normal(size=(8000, 3))) * 3.0, matrix)
    along = normalized(moved(0.7 * aims(rng, mesh, 8000), matrix) - origins.astype(np.float32))
    rig.colors(ls.Scene([], [ls.MeshInstance(mesh, matrix)]), origins, along, bounces=1)
    wave = rig.waves[1]
    refracted = np.arange(len(wave.t_max)) >= len(wave.t_max) - 8000
    assert np.isfinite(wave.t_max[refracted]).all(), f"{np.isinf(wave.t_max[refracted]).sum()} rays leaked"
    assert np.isinf(wave.t_max[~refracted]).all()
    assert np.median(wave.t_max[refracted]) > 0.5 * scale
    assert (wave.t_max[refracted] > 1e-3 * scale).mean() > 0.999


def test_glass_body_mirrored_by_its_transform_renders_like_a_mesh_with_mirrored_vertices(rig: RayRig) -> None:
    """Colours of the mirrored instance equal those of a mesh with mirrored vertices."""
    mesh = shapes.rounded_box((1.0, 2.0, 0.8), 0.2)
    lens = replace(mesh, material=replace(GLASS, base_color=(0.9, 0.7, 0.4)))
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    by_hand = replace(
        lens,
        positions=lens.positions * np.array([-1, 1, 1], np.float32),
        normals=present(lens.normals) * np.array([-1, 1, 1], np.float32),
        indices=lens.indices[:, ::-1],
    )
    rng = np.random.default_rng(6)
    pose = similarity((0.2, 1.0, 0.3), 0.7, 1.0, (0.1, 0.0, 4.0))
    along = normalized(np.append(rng.uniform(-0.25, 0.25, (3000, 2)), np.ones((3000, 1)), axis=1))
    wall = quad(
        8.0, 9.0, uvs=[[0, 0], [9, 0], [9, 9], [0, 9]], material=replace(LIGHT, base_color_texture=noise_texture())
    )
    views = [
        rig.colors(ls.Scene([], [ls.MeshInstance(body, matrix), wall]), np.zeros((3000, 3)), along, bounces=4)
        for body, matrix in ((lens, pose @ flip), (by_hand, pose))
    ]
    off = np.abs(views[0] - views[1]).max(axis=1) > 1e-3
    assert off.mean() < 0.01
    assert views[0].std() > 0.1


def noise_texture() -> np.ndarray:
    """Returns a smooth random texture."""
    return np.random.default_rng(7).integers(0, 256, (8, 8, 3), dtype=np.uint8)


# --- The machinery ---


def test_colours_of_mirrors_and_glass_do_not_depend_on_thread_count() -> None:
    """The bits are equal with one thread and with three."""
    rng = np.random.default_rng(8)
    along = normalized(np.append(rng.uniform(-0.3, 0.3, (5000, 2)), np.ones((5000, 1)), axis=1))
    scene = ls.Scene([], [ls.MeshInstance(ball(GLASS, 2), similarity(offset=(0, 0, 4))), quad(7.0, 3.0)])
    one, three = (RayRig("cpu", threads).colors(scene, np.zeros((5000, 3)), along, bounces=5) for threads in (1, 3))
    np.testing.assert_array_equal(one, three)


def test_mirror_and_glass_rays_of_a_similar_next_view_allocate_no_memory(rig: RayRig) -> None:
    """A view with a few more or fewer rays in glass allocates nothing, and earlier rays do not change its colours."""
    rng = np.random.default_rng(9)
    along = normalized(np.append(rng.uniform(-0.3, 0.3, (5000, 2)), np.ones((5000, 1)), axis=1))
    lens = ball(GLASS, 2)
    scenes = [ls.Scene([], [ls.MeshInstance(lens, similarity(offset=(x, 0.0, 4.0)))]) for x in (0.0, 0.01, 0.02)]
    first = rig.colors(scenes[0], np.zeros((5000, 3)), along, bounces=5, background=WHITE)
    allocations = rig.buffers.allocations
    *_, again = (rig.colors(scene, np.zeros((5000, 3)), along, bounces=5, background=WHITE) for scene in scenes)
    assert rig.buffers.allocations == allocations
    fresh = RayRig("cpu").colors(scenes[2], np.zeros((5000, 3)), along, bounces=5, background=WHITE)
    np.testing.assert_allclose(again, fresh, atol=1e-6)
    back = rig.colors(scenes[0], np.zeros((5000, 3)), along, bounces=5, background=WHITE)
    np.testing.assert_array_equal(back, first)


def test_tracing_zero_rays_through_mirrors_and_glass_returns_empty_arrays(rig: RayRig) -> None:
    """The colours have shape (0, 3)."""
    seen = rig.colors(ls.Scene([], [quad(2.0, material=MIRROR)]), np.zeros((0, 3)), np.zeros((0, 3)))
    assert seen.shape == (0, 3)
