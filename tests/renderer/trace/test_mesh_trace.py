"""The nearest triangle on each ray, compared with brute force in float64; closed meshes do not leak."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.demo import shapes
from support.oracles.mirror_oracle import Ray, nearest, triangles_of
from support.oracles.raster_oracle import normalized
from support.scenes.raster_scenes import quad, rotation, similarity
from support.scenes.ray_rig import Hits, RayRig

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
SHEAR = np.array([[1.0, 0.5, 0.0, 0.0], [0.0, 0.6, 0.2, 0.0], [0.0, 0.0, 1.2, 0.0], [0.0, 0.0, 0.0, 1.0]])
MIRRORED = SHEAR @ np.diag([1.0, 1.0, -1.0, 1.0])


@pytest.fixture(params=DEVICES)
def rig(request: pytest.FixtureRequest) -> RayRig:
    """Returns a rig that traces rays on a device."""
    return RayRig(request.param)


def cube() -> ls.Mesh:
    """Returns a cube of twelve triangles around the origin with shared corners, from -1 to 1."""
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return ls.Mesh(corners, np.array(faces))


def soup(seed: int, count: int) -> ls.Mesh:
    """Returns triangles of random size in a box."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-1.0, 1.0, (count, 1, 3))
    corners = centers + rng.normal(size=(count, 3, 3)) * np.exp(rng.uniform(-4.0, 0.0, (count, 1, 1)))
    return ls.Mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Returns N unit vectors, shape (N, 3)."""
    return normalized(rng.normal(size=(count, 3)))


def assert_as_brute_force(scene: ls.Scene, hits: Hits, origins: np.ndarray, along: np.ndarray, t_min: float) -> None:
    """Asserts face, instance, distance and weights of all rays but the few that float32 may decide otherwise."""
    triangles = triangles_of(scene)
    faces = np.cumsum([0, *(instance.mesh.face_count for instance in scene.meshes)])
    meshes = list({id(instance.mesh): instance.mesh for instance in scene.meshes}.values())
    starts = dict(zip(map(id, meshes), np.cumsum([0, *(mesh.face_count for mesh in meshes)]), strict=False))
    doubtful = 0
    for i, (origin, direction) in enumerate(zip(origins, along, strict=True)):
        hit = nearest(triangles, Ray(origin, direction, t_min))
        if hit.doubtful:
            doubtful += 1
            continue
        assert np.isinf(hits.t[i]) == (hit.triangle < 0), f"ray {i}"
        if hit.triangle < 0:
            assert hits.face[i] == -1
            continue
        instance = triangles.instance[hit.triangle]
        mesh = scene.meshes[instance].mesh
        assert hits.instance[i] == instance, f"ray {i}"
        assert hits.face[i] == starts[id(mesh)] + hit.triangle - faces[instance], f"ray {i}"
        assert hits.t[i] == pytest.approx(hit.t, rel=2e-6, abs=4.0 * hit.error)
        np.testing.assert_allclose(hits.weights[i], hit.weights, atol=2e-3)
    assert doubtful < 0.1 * len(origins)


@pytest.mark.parametrize("t_min", [0.0, 1.5])
def test_nearest_triangle_hits_equal_brute_force(rig: RayRig, t_min: float) -> None:
    """Random triangles are in several instances, some of them sheared or mirrored."""
    rng = np.random.default_rng(1)
    mesh, other = soup(2, 60), soup(3, 30)
    poses = [np.eye(4), similarity((1.0, 2.0, 0.5), 1.1, 0.7, (1.0, 0.0, 0.5)), similarity(offset=(-1, 0.5, 0)) @ SHEAR]
    poses.append(similarity(offset=(0.0, -0.5, 1.0)) @ MIRRORED)
    scene = ls.Scene([], [*(ls.MeshInstance(mesh, pose) for pose in poses), ls.MeshInstance(other, poses[1])])
    origins = rng.normal(0.0, 2.0, (500, 3)).astype(np.float32)
    along = normalized(rng.normal(0.0, 0.5, (500, 3)) - origins).astype(np.float32)
    hits = rig.hits(scene, origins, along, t_min=t_min)
    assert 0.2 < (hits.face >= 0).mean() < 0.95
    assert_as_brute_force(scene, hits, origins.astype(float), along.astype(float), t_min)


def test_hit_distance_on_a_scaled_mesh_instance_is_in_world_units(rig: RayRig) -> None:
    """However an instance is scaled, the distance is measured along the ray in world space."""
    for scale in (1e-3, 1.0, 1e3):
        scene = ls.Scene([], [ls.MeshInstance(quad(5.0, 50.0), similarity(scale=scale))])
        hits = rig.hits(scene, [[0.0, 0.0, 0.0]], [[0.0, 0.6, 0.8]])
        assert hits.t[0] == pytest.approx(5.0 * scale / 0.8, rel=1e-6)


def test_triangle_hits_at_the_start_t_min_of_a_ray_are_skipped(rig: RayRig) -> None:
    """Triangles through the origin of the ray are skipped as well; the next triangle is hit."""
    scene = ls.Scene([], [quad(z) for z in (0.0, 2.0, 3.0)])
    t_min = np.array([0.0, 1.999, 2.0, 2.001, 3.0])
    origins, along = np.zeros((5, 3)), np.tile([0.0, 0.0, 1.0], (5, 1))
    hits = rig.hits(scene, origins, along, t_min=t_min)
    np.testing.assert_array_equal(hits.t, [2.0, 2.0, 3.0, 3.0, np.inf])
    np.testing.assert_array_equal(hits.instance, [1, 1, 2, 2, -1])


def test_triangle_hits_beyond_the_end_t_max_of_a_ray_are_skipped(rig: RayRig) -> None:
    """Without a nearer hit, ``t_max`` is returned; a ray whose ``t_max`` is not above ``t_min`` is inactive."""
    scene = ls.Scene([], [quad(2.0)])
    t_max = np.array([1.9, 2.1, np.inf, 0.0, -np.inf])
    hits = rig.hits(scene, np.zeros((5, 3)), np.tile([0.0, 0.0, 1.0], (5, 1)), t_max=t_max)
    np.testing.assert_array_equal(hits.t, np.array([1.9, 2.0, 2.0, 0.0, -np.inf], np.float32))
    np.testing.assert_array_equal(hits.face >= 0, [False, True, True, False, False])


def test_ray_hits_the_lowest_instance_and_face_of_coinciding_triangles(rig: RayRig) -> None:
    """The lowest instance wins, then the lowest face."""
    one = quad(2.0)
    twice = ls.Mesh(one.positions, np.concatenate([one.indices, one.indices]))
    rng = np.random.default_rng(4)
    aims = np.append(rng.uniform(-1.0, 1.0, (200, 2)), np.full((200, 1), 2.0), axis=1)
    hits = rig.hits(ls.Scene([], [twice, twice]), np.zeros((200, 3)), normalized(aims))
    assert (hits.instance == 0).all() and (hits.face < 2).all()


def test_rays_in_a_scene_without_meshes_hit_nothing(rig: RayRig) -> None:
    """Tracing needs no tree."""
    hits = rig.hits(ls.Scene(), np.zeros((3, 3)), np.eye(3))
    assert np.isinf(hits.t).all() and (hits.face == -1).all()


@pytest.mark.parametrize("pose", ["turned", "sheared"])
@pytest.mark.parametrize(("scale", "offset"), [(1e-3, 0.0), (1.0, 0.0), (1e3, 0.0), (1.0, 1e3)])
@pytest.mark.parametrize("shape", ["cube", "sphere", "icosphere"])
def test_rays_aimed_at_closed_meshes_do_not_leak_through_edges_or_corners(
    rig: RayRig, shape: str, scale: float, offset: float, pose: str
) -> None:
    """Rays start inside and far away, and are aimed at faces, edges and corners."""
    mesh = {"cube": cube(), "sphere": shapes.sphere(), "icosphere": shapes.icosphere(subdivisions=4)}[shape]
    rng = np.random.default_rng(5)
    matrix = similarity((1.0, 2.0, 0.5), 0.9, scale, (0.8 * offset, -0.6 * offset, 0.0))
    matrix = matrix @ SHEAR if pose == "sheared" else matrix
    count = 6000
    faces = mesh.indices[rng.integers(0, mesh.face_count, 3 * count)]
    weights = rng.dirichlet((1.0, 1.0, 1.0), 3 * count)
    weights[count : 2 * count, 0] = 0.0
    weights[2 * count :] = [1.0, 0.0, 0.0]
    aims = np.einsum("nk,nkc->nc", normalized_sum(weights), mesh.positions[faces].astype(float))
    inside = 0.5 * directions(rng, 3 * count)
    outside = aims + (aims - inside) * rng.choice([3.0, 300.0, 30000.0], (3 * count, 1))
    end = aims @ matrix[:3, :3].T + matrix[:3, 3]
    for start in (inside, outside):
        begin = (start @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
        hits = rig.hits(ls.Scene([], [ls.MeshInstance(mesh, matrix)]), begin, normalized(end - begin))
        through = hits.t > np.linalg.norm(end - begin, axis=1) + 0.1 * scale
        assert not through.any(), f"{through.sum()} of {len(hits.t)} rays got through"


def normalized_sum(weights: np.ndarray) -> np.ndarray:
    """Returns the rows divided by their sums."""
    return weights / weights.sum(axis=1, keepdims=True)


def test_axis_aligned_rays_hit_axis_aligned_boxes(rig: RayRig) -> None:
    """Directions have zeros; rays start and end at all positions of a cube, edges included."""
    steps = np.linspace(-1.0, 1.0, 9)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            origins = np.insert(grid, axis, -3.0 * sign, axis=1)
            along = np.zeros((len(grid), 3))
            along[:, axis] = sign
            np.testing.assert_array_equal(rig.hits(ls.Scene([], [cube()]), origins, along).t, np.full(len(grid), 2.0))


def test_hits_on_small_far_triangles_have_exact_distances(rig: RayRig) -> None:
    """Irregular triangles of a hundredth of their distance and less have their plane's depth up to float32 rounding."""
    rng = np.random.default_rng(6)
    count = 200
    y, x = (np.mgrid[:count, :count] + rng.uniform(-0.3, 0.3, (2, count, count))) / (count - 1) * 2.0 - 1.0
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).reshape(-1, 1)
    faces = np.concatenate([np.add(corner, [0, 1, count]), np.add(corner, [1, count + 1, count])])
    normal = np.array([0.5, -0.3, -1.0])
    points = np.stack([x, y, 300.0 + normal[0] * x + normal[1] * y], axis=-1).reshape(-1, 3)
    aims = np.append(rng.uniform(-0.9, 0.9, (5000, 2)), np.full((5000, 1), 300.0), axis=1)
    along = normalized(aims).astype(np.float32).astype(float)
    hits = rig.hits(ls.Scene([], [ls.Mesh(points, faces)]), np.zeros((5000, 3)), along)
    expected = 300.0 * normal[2] / (along @ normal)
    np.testing.assert_allclose(hits.t / expected, 1.0, atol=3e-7)


@pytest.mark.parametrize("size", [1e-30, 1e19, 1e30])
def test_rays_still_hit_other_objects_beside_triangles_of_extreme_size(rig: RayRig, size: float) -> None:
    """Sizes of the triangles overflow or underflow float32."""
    extreme = ls.Mesh(size * np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [-1.0, 0.0, 1.0]]), np.array([[0, 1, 2]]))
    along = directions(np.random.default_rng(7), 1000)
    along[:, 2] = np.abs(along[:, 2]) + 0.5
    hits = rig.hits(ls.Scene([], [extreme, quad(5.0, 50.0)]), np.full((1000, 3), 0.1), normalized(along))
    assert (hits.instance == 1).mean() > 0.9
    assert not np.isnan(hits.t).any()


def test_triangle_hits_do_not_depend_on_thread_count() -> None:
    """All hit arrays have equal bits."""
    rng = np.random.default_rng(8)
    scene = ls.Scene([], [soup(9, 500)])
    origins, along = rng.normal(size=(3000, 3)), directions(rng, 3000)
    one, three = (RayRig("cpu", threads).hits(scene, origins, along) for threads in (1, 3))
    for name in ("t", "face", "instance", "weights"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))


def test_mesh_bvh_is_built_once_and_freed_with_its_mesh(rig: RayRig) -> None:
    """Moving an instance builds nothing; a mesh that leaves the scene is freed, and a new mesh is hit."""
    mesh = quad(2.0)
    ray = ([[0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    assert rig.hits(ls.Scene([], [mesh]), *ray).t[0] == 2.0
    version, held = rig.scene.version, rig.scene.bytes
    assert rig.hits(ls.Scene([], [ls.MeshInstance(mesh, similarity(offset=(0.0, 0.0, 1.0)))]), *ray).t[0] == 3.0
    assert (rig.scene.version, rig.scene.bytes) == (version, held)
    assert rig.hits(ls.Scene([], [mesh, quad(1.0)]), *ray).t[0] == 1.0
    assert rig.scene.bytes > held
    assert rig.hits(ls.Scene([], [quad(4.0)]), *ray).t[0] == 4.0
    assert rig.scene.bytes == held


def test_rays_hit_the_rotated_mesh_instance_they_are_aimed_at(rig: RayRig) -> None:
    """Hundreds of instances of one mesh have different rotations."""
    rng = np.random.default_rng(10)
    mesh = shapes.icosphere(0.4, subdivisions=1)
    centers = np.stack(np.meshgrid(*[np.arange(7.0)] * 3), axis=-1).reshape(-1, 3)
    poses = []
    for center in centers:
        pose = rotation(tuple(rng.normal(size=3)), 2.0)
        pose[:3, 3] = center
        poses.append(pose)
    scene = ls.Scene([], [ls.MeshInstance(mesh, pose) for pose in poses])
    hits = rig.hits(scene, np.add(centers, (0.01, 0.02, 0.6)), np.tile([0.0, 0.0, -1.0], (len(centers), 1)))
    np.testing.assert_array_equal(hits.instance, np.arange(len(centers)))
