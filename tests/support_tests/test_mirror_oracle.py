"""The oracle's triangles, mirrors and glass agree with formulas."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lumisplat.config import HitDistance, TraceStrategy
from lumisplat.math.color import encode_srgb
from lumisplat.scene.materials import MaterialPbr
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene
from support.oracles import raster_oracle as oracles, trace_oracle
from support.oracles.mirror_oracle import MeshHit, Ray, Triangles, fresnel, nearest, refracted, schlick, triangles_of
from support.oracles.trace_oracle import Traced, trace_one
from support.scenes.raster_scenes import one_gaussian, quad, random_gaussians, similarity
from support.scenes.trace_scenes import AXIS, GLASS, MIRROR, ball, random_ray, slab, trace_config


def traced(scene: Scene, ray: Ray = AXIS, background: float = 0.0, **settings: Any) -> Traced:
    """Traces a ray over a grey background; ``settings`` are those of ``trace_config``."""
    return trace_one(scene, ray, trace_config((background, background, background), **settings))


def test_ray_tracing_oracle_finds_the_closest_triangle_from_either_side() -> None:
    """The closest triangle of all instances is found from either side, with its distance and barycentric weights."""
    rng = np.random.default_rng(0)
    meshes = [MeshInstance(quad(0.0), similarity(tuple(rng.normal(size=3)), i, 0.8, (0, 0, 3.0 + i))) for i in range(4)]
    triangles = triangles_of(Scene([], meshes))
    hit_count = 0
    for _ in range(200):
        ray = random_ray(rng)
        hit = nearest(triangles, ray)
        distances = []
        for a, b, c in triangles.corners:
            matrix = np.stack([-ray.direction, b - a, c - a], axis=1)
            t, u, v = np.linalg.solve(matrix, ray.origin - a)
            if min(u, v, 1.0 - u - v) >= 0.0 and t > 0.0:
                distances.append(t)
        assert hit.t == pytest.approx(min(distances, default=np.inf), rel=1e-9)
        if distances:
            hit_count += 1
            np.testing.assert_allclose(hit.weights @ triangles.corners[hit.triangle], ray.at(hit.t), atol=1e-9)
    assert hit_count > 20


def test_mesh_hides_gaussians_whose_response_peaks_behind_it() -> None:
    """Only Gaussians that peak in front of the mesh count, also in hull mode, where hits precede peaks."""
    scene = Scene([one_gaussian((0.0, 0.0, 4.0), 0.2, 0.2), one_gaussian((0.0, 0.0, 5.0), 0.4, 0.2)], [quad(4.5)])
    color = encode_srgb(np.full(3, 0.8))
    one = traced(scene)
    assert one.color == pytest.approx(0.2 * np.array([0.9, 0.5, 0.1]) + 0.8 * color, abs=1e-6)
    assert (one.alpha, one.instance_index, one.gaussian_index) == (1.0, 2, -1)
    assert one.depth == pytest.approx(4.5)
    assert one.normal == pytest.approx([0.0, 0.0, -1.0])
    hull = traced(scene, hit_distance=HitDistance.HULL)
    assert hull.color == pytest.approx(one.color)
    assert (hull.alpha, hull.instance_index, hull.depth) == (1.0, 2, pytest.approx(4.5))


def test_fresnel_reflectance_has_its_textbook_values() -> None:
    """Reflectance is ((n - 1) / (n + 1))^2 head on, half the s part at Brewster's angle, 1 at grazing."""
    assert fresnel(1.0, 1.0 / 1.5)[0] == pytest.approx(0.04)
    assert fresnel(1.0, 1.5)[0] == pytest.approx(0.04)
    brewster = np.arctan(1.5)
    assert fresnel(np.cos(brewster), 1.0 / 1.5)[0] == pytest.approx(0.5 * np.cos(2.0 * brewster) ** 2)
    assert fresnel(1e-9, 1.0 / 1.5)[0] == pytest.approx(1.0, abs=1e-6)
    critical = np.arcsin(1.0 / 1.5)
    assert fresnel(np.cos(critical + 1e-6), 1.5) == (1.0, 0.0)
    assert fresnel(np.cos(critical - 1e-6), 1.5)[0] < 1.0
    assert fresnel(0.6, 1.0) == (pytest.approx(0.0), pytest.approx(0.6))
    assert schlick(np.array([0.3, 0.6, 1.0]), 1.0) == pytest.approx([0.3, 0.6, 1.0])
    assert schlick(np.array([0.3, 0.6, 1.0]), 0.0) == pytest.approx([1.0, 1.0, 1.0])


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2])
def test_refracted_direction_obeys_snells_law(angle: float) -> None:
    """Sines are in the ratio of the indices, and the ray stays in the plane of incidence."""
    direction, normal = np.array([np.sin(angle), 0.0, np.cos(angle)]), np.array([0.0, 0.0, -1.0])
    through = refracted(direction, normal, 1.0 / 1.5, fresnel(np.cos(angle), 1.0 / 1.5)[1])
    assert through == pytest.approx([np.sin(angle) / 1.5, 0.0, np.sqrt(1.0 - (np.sin(angle) / 1.5) ** 2)])


def watched(scene: Scene, ray: Ray, monkeypatch: pytest.MonkeyPatch, **changes: Any) -> list[Ray]:
    """Returns a list that collects all branches of a ray in the order in which they are traced."""
    rays: list[Ray] = []

    def watch(triangles: Triangles, ray: Ray) -> MeshHit:
        rays.append(ray)
        return nearest(triangles, ray)

    monkeypatch.setattr(trace_oracle, "nearest", watch)
    traced(scene, ray, **changes)
    return rays


@pytest.mark.parametrize("angle", [0.2, 0.9])
def test_glass_slab_shifts_a_ray_and_keeps_its_direction(angle: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slab shifts a ray sideways by d sin(a) (1 - cos a / (n cos b)) and keeps its direction."""
    ray = Ray(np.zeros(3), np.array([np.sin(angle), 0.0, np.cos(angle)]))
    rays = watched(Scene([], [slab(4.0, 0.5, GLASS)]), ray, monkeypatch)
    out = [one for one in rays if one.origin[2] > 4.4 and one.direction[2] > 0.0]
    cosine = np.sqrt(1.0 - (np.sin(angle) / 1.5) ** 2)
    shift = 0.5 * np.sin(angle) * (1.0 - np.cos(angle) / (1.5 * cosine))
    assert out[0].direction == pytest.approx(ray.direction)
    assert np.linalg.norm(np.cross(out[0].origin, out[0].direction)) == pytest.approx(shift)
    assert out[0].path_length == pytest.approx(4.0 / np.cos(angle) + 0.5 / cosine)


@pytest.mark.parametrize("height", [0.2, 0.6, 0.9])
def test_glass_sphere_deflects_a_ray_by_the_closed_form(height: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """A glass ball deflects a ray by 2 (a - b), with sin a = height / radius and sin b = sin a / n."""
    scene = Scene([], [ball(GLASS, detail=5)])
    rays = watched(scene, Ray(np.array([height, 0.01, 0.0]), AXIS.direction), monkeypatch)
    out = rays[np.argmax([one.origin[2] * (one.direction[2] > 0.0) for one in rays])]
    a = np.arcsin(np.hypot(height, 0.01))
    turned = 2.0 * (a - np.arcsin(np.sin(a) / 1.5))
    assert np.arccos(out.direction[2]) == pytest.approx(turned, abs=5e-3)
    assert out.direction[0] < 0.0


def test_total_internal_reflection_loses_no_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Inside glass beyond the critical angle (41.8 degrees), all light is reflected and none is lost."""
    scene = Scene([], [slab(4.0, 0.5, replace(GLASS, specular=0.0))])
    for angle, count in ((0.71, 2), (0.75, 2)):
        ray = Ray(np.array([0.0, 0.0, 4.2]), np.array([np.sin(angle), 0.0, np.cos(angle)]))
        rays = watched(scene, ray, monkeypatch, bounces=1)
        assert len(rays) == count
        assert (rays[1].direction[2] > 0.0) == (angle < np.arcsin(1.0 / 1.5))
        assert traced(scene, ray, background=0.6, bounces=1).color == pytest.approx([0.6] * 3)


def test_plane_mirror_shows_what_an_eye_mirrored_in_it_would_see() -> None:
    """A mirror at 45 degrees shows the view of a mirrored eye, including view-dependent colours."""
    half = 9.0
    tilted = Mesh(
        np.array(
            [[-half, -half, 4.0 - half], [half, -half, 4.0 + half], [half, half, 4.0 + half], [-half, half, 4.0 - half]]
        ),
        np.array([[0, 2, 1], [0, 3, 2]]),
        material=MIRROR,
    )
    splats = random_gaussians(9, 200, degree=3, center=(4.0, 0.0, 4.0))
    rng = np.random.default_rng(4)
    normal = np.array([1.0, 0.0, -1.0]) / np.sqrt(2.0)
    flip = np.eye(3) - 2.0 * np.outer(normal, normal)
    centre = np.array([0.0, 0.0, 4.0])
    seen = 0
    for _ in range(20):
        direction = oracles.normalized(np.array([0.3, 0.3, 4.0]) * rng.uniform(-1.0, 1.0, 3) * [1, 1, 0] + [0, 0, 4])
        ray = Ray(np.zeros(3), direction)
        distance = nearest(triangles_of(Scene([], [tilted])), ray).t
        behind = Ray(flip @ -centre + centre, flip @ direction, t_min=distance)
        expected = traced(Scene([splats]), behind, background=0.2)
        actual = traced(Scene([splats], [tilted]), ray, background=0.2)
        np.testing.assert_allclose(actual.color, expected.color, atol=1e-9)
        assert (actual.alpha, actual.instance_index) == (1.0, 1)
        assert actual.depth == pytest.approx(distance)
        seen += expected.alpha > 0.1
    assert seen > 10


def test_metal_tints_reflection_and_glass_tints_transmission() -> None:
    """The remaining light of a dielectric is its flat colour; all colours are sRGB encoded."""
    base = np.array([0.2, 0.5, 0.8])
    metal = replace(MIRROR, base_color=tuple(base))
    assert traced(Scene([], [quad(4.0, material=metal)]), background=0.5).color == pytest.approx(
        0.5 * encode_srgb(base)
    )
    glass = replace(GLASS, base_color=tuple(base), transmission=0.7)
    expected = 0.04 * 0.5 + 0.96 * (0.7 * 0.5 + 0.3) * encode_srgb(base)
    assert traced(Scene([], [quad(4.0, material=glass)]), background=0.5).color == pytest.approx(expected)
    half = replace(metal, metallic=0.5, specular=0.5)
    expected = 0.5 * 0.5 * encode_srgb(base) + 0.5 * (0.02 * 0.5 + 0.98 * encode_srgb(base))
    assert traced(Scene([], [quad(4.0, material=half)]), background=0.5).color == pytest.approx(expected)
    rough = replace(metal, roughness=0.1)
    assert traced(Scene([], [quad(4.0, material=rough)]), background=0.5).color == pytest.approx(encode_srgb(base))


def test_mirror_at_the_maximum_of_bounces_shows_the_background() -> None:
    """Each reflection between two mirrors counts against ``max_bounces``; the last mirror shows the background."""
    mirror = quad(4.0, 2.0, material=MIRROR)
    scene = Scene([], [mirror, MeshInstance(mirror, similarity(offset=(0.0, 0.0, -8.0)))])
    assert traced(Scene([], [mirror]), background=0.5).color == pytest.approx([0.5] * 3)
    assert traced(Scene([], [mirror]), background=0.5, bounces=0).color == pytest.approx([0.5] * 3)
    red = MeshInstance(
        quad(4.0, 2.0, material=replace(MIRROR, roughness=1.0, metallic=0.0, base_color=(1.0, 0.0, 0.0)))
    )
    behind = Scene([], [mirror, replace(red, world_from_object=similarity(offset=(0.0, 0.0, -8.0)))])
    for bounces, seen in ((0, (0.5, 0.5, 0.5)), (1, (1.0, 0.0, 0.0))):
        assert traced(behind, background=0.5, bounces=bounces).color == pytest.approx(seen)
    out = Ray(np.zeros(3), oracles.normalized(np.array([0.6, 0.0, 5.0])))
    for bounces in (1, 2, 5):  # The ray leaves the mirrors sideways after two reflections.
        assert traced(scene, out, background=0.5, bounces=bounces).color == pytest.approx([0.5] * 3)


@pytest.mark.parametrize("material", [MIRROR, GLASS, replace(GLASS, metallic=0.3, specular=0.4, ior=2.0)])
def test_white_mirrors_and_clear_glass_conserve_energy(material: MaterialPbr, monkeypatch: pytest.MonkeyPatch) -> None:
    """A white mirror or clear glass is invisible in a uniform world: energy is conserved."""
    monkeypatch.setattr(trace_oracle, "BOUNCE_WEIGHT_MIN", 1e-9)
    scene = Scene([], [ball(material)])
    rng = np.random.default_rng(0)
    hit_count = 0
    for _ in range(12):
        one = traced(
            scene, Ray(np.array([*rng.uniform(-0.6, 0.6, 2), 0.0]), AXIS.direction), background=0.6, bounces=24
        )
        assert one.color == pytest.approx([0.6] * 3, abs=2e-4)
        hit_count += one.alpha == 1.0
    assert hit_count == 12


def test_rays_enter_and_leave_glass_at_the_same_faces_under_a_mirroring_transform(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Glass keeps its inside under a mirroring transform."""
    ray = Ray(np.zeros(3), oracles.normalized(np.array([0.3, 0.1, 1.0])))
    plain = slab(4.0, 0.5, GLASS)
    flipped = MeshInstance(plain, similarity(offset=(0.0, 0.0, 8.5)) @ np.diag([1.0, 1.0, -1.0, 1.0]))
    expected = watched(Scene([], [plain]), ray, monkeypatch)
    actual = watched(Scene([], [flipped]), ray, monkeypatch)
    assert len(actual) == len(expected) > 3
    for one, other in zip(actual, expected, strict=True):
        assert one.direction == pytest.approx(other.direction)
        assert one.origin == pytest.approx(other.origin)


@pytest.mark.parametrize("material", [MIRROR, GLASS])
def test_shading_normal_that_would_reflect_a_ray_into_the_surface_is_not_used(
    material: MaterialPbr, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The triangle's normal replaces a shading normal that would reflect a ray into the surface."""
    steep = np.tile(oracles.normalized(np.array([1.0, 0.0, -0.3])), (4, 1))
    for normals, expected in ((steep, [0.0, 0.0, -1.0]), (-steep, [0.0, 0.0, -1.0]), (None, [0.0, 0.0, -1.0])):
        mesh = replace(quad(4.0, material=material), normals=normals)
        assert watched(Scene([], [mesh]), AXIS, monkeypatch)[1].direction == pytest.approx(expected)
    gentle = np.tile(oracles.normalized(np.array([0.2, 0.0, -1.0])), (4, 1))
    mirrored = watched(Scene([], [replace(quad(4.0, material=material), normals=gentle)]), AXIS, monkeypatch)[1]
    assert mirrored.direction == pytest.approx(np.array([0.4, 0.0, -0.96]) / 1.04)


def test_colour_variance_of_the_stochastic_oracle_includes_outcomes_in_mirrors() -> None:
    """A Gaussian before the mirror, one in the mirror and the background are the possible outcomes of a ray."""
    before = one_gaussian((0.0, 0.0, 2.0), opacity=0.3)
    dark = one_gaussian((0.0, 0.0, -2.0), opacity=0.6, color=(0.2, 0.3, 0.4))
    # The mirrored ray hits the first Gaussian a second time.
    grey = replace(MIRROR, base_color=(0.5, 0.5, 0.5))
    scene = Scene([before, dark], [quad(4.0, 2.0, material=grey)])
    chance = np.array([0.3, 0.7 * 0.3, 0.49 * 0.6, 0.49 * 0.4])
    values = np.array([[0.9, 0.5, 0.1], [0.9, 0.5, 0.1], [0.2, 0.3, 0.4], [0.8, 0.8, 0.8]])
    values[1:] *= encode_srgb(np.full(3, 0.5))
    one = traced(scene, background=0.8, strategy=TraceStrategy.STOCHASTIC_HIT)
    assert one.color == pytest.approx(chance @ values, rel=1e-6)
    assert one.color_variance == pytest.approx(chance @ values**2 - (chance @ values) ** 2, rel=1e-5)
    assert one.alpha == 1.0


def test_oracle_marks_rays_that_lie_within_the_plane_of_a_mirror_as_doubtful() -> None:
    """A ray within a mirror's plane is doubtful, since rounding decides from which side the ray comes."""
    scene = Scene([], [quad(4.0, material=MIRROR)])
    for slope, slack in ((1e-5, np.inf), (1e-2, 0.0)):
        ray = Ray(np.array([-1.5, 0.1, 4.0 - slope]), oracles.normalized(np.array([1.0, 0.0, slope])))
        assert traced(scene, ray).alpha == 1.0
        assert traced(scene, ray).slack == slack
