"""Given Gaussians follow a rig: by weights, by its triangles, or by its bones, with covariances, SH and normals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lumisplat as ls
from lumisplat.math.sh import rotate_sh, sh_basis, sh_rotation
from lumisplat.scene.animation.bindings import JointBinding, nearest_on_triangles
from lumisplat.scene.animation.deformation import deform, nearest_rotations
from lumisplat.scene.animation.rig import Channel, Clip, Interpolation, Rig, Skeleton, Track
from support.files.rig_files import BEND, TubeRig
from support.kinds import present
from support.oracles.rig_oracle import world_matrices

RNG = np.random.default_rng(49)


def some_gaussians(means: np.ndarray, seed: int = 1, **changes: object) -> ls.Gaussians:
    """Returns Gaussians with random rotations, scales, degree-2 SH and normals at the means, shape (N, 3)."""
    rng = np.random.default_rng(seed)
    count = len(means)
    normals = rng.standard_normal((count, 3))
    columns = {
        "rotations_wxyz": rng.standard_normal((count, 4)),
        "scales": rng.uniform(0.01, 0.3, (count, 3)),
        "opacities": rng.uniform(0.2, 0.9, count),
        "sh": 0.3 * rng.standard_normal((count, 9, 3)),
        "normals": normals / np.linalg.norm(normals, axis=1, keepdims=True),
    }
    return ls.Gaussians(means, **(columns | changes))  # pyright: ignore[reportArgumentType]


def covariances(gaussians: ls.Gaussians) -> np.ndarray:
    """Returns covariance matrices, shape (N, 3, 3)."""
    axes = Rotation.from_quat(np.roll(gaussians.rotations_wxyz.astype(float), -1, axis=1)).as_matrix()
    axes = axes * gaussians.scales.astype(float)[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_deformed_gaussians_follow_an_affine_map_exactly():
    """Means, covariances and normals follow the map; SH have at R d the value they had at d."""
    count = 200
    means = RNG.uniform(-1.0, 1.0, (count, 3))
    gaussians = some_gaussians(means)
    maps = np.concatenate([np.eye(3) + 0.4 * RNG.standard_normal((count, 3, 3)), RNG.standard_normal((count, 3, 1))], 2)
    maps[:50, :, :3] = 1.7 * Rotation.from_quat(RNG.standard_normal((50, 4))).as_matrix()
    linear = maps[:, :, :3]
    kept = np.linalg.det(linear) > 0.05
    gaussians, maps, linear = gaussians.subset(np.flatnonzero(kept)), maps[kept], linear[kept]
    moved = deform(gaussians, maps)
    expected = np.einsum("nij,nj->ni", linear, gaussians.means) + maps[:, :, 3]
    np.testing.assert_allclose(moved.means, expected, atol=2e-6)
    wanted = linear @ covariances(gaussians) @ linear.transpose(0, 2, 1)
    largest = np.trace(wanted, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(covariances(moved) / largest, wanted / largest, atol=3e-5)
    normals = np.array([np.linalg.inv(a).T @ n for a, n in zip(linear, present(gaussians.normals), strict=True)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(present(moved.normals), normals, atol=1e-5)
    left, _, right = np.linalg.svd(linear)
    for row in (0, 60, 99):
        turn = left[row] @ right[row]
        directions = RNG.standard_normal((8, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        before = sh_basis(directions, 2) @ gaussians.sh[row]
        np.testing.assert_allclose(sh_basis(directions @ turn.T, 2) @ moved.sh[row], before, atol=1e-5)
    assert moved.opacities is gaussians.opacities


def test_a_map_that_flattens_a_gaussian_hides_it_and_only_it():
    """A singular or mirroring map makes its Gaussian transparent and leaves finite values."""
    maps = np.tile(np.eye(3, 4), (3, 1, 1))
    maps[1, :, 2] = 0.0
    maps[2, 0, 0] = -1.0
    moved = deform(some_gaussians(np.zeros((3, 3))), maps)
    assert moved.opacities[0] > 0.0
    np.testing.assert_array_equal(moved.opacities[1:], 0.0)


def test_a_map_to_other_units_hides_no_gaussian():
    """A uniform scale of any size, such as that of a triangle of a head in metres, scales a Gaussian and keeps it."""
    gaussians = some_gaussians(np.ones((4, 3)))
    sizes = np.array([1e-9, 0.002, 1e3, 0.0])
    maps = np.concatenate([sizes[:, None, None] * np.eye(3), np.zeros((4, 3, 1))], axis=2)
    moved = deform(gaussians, maps)
    np.testing.assert_array_equal(moved.opacities, np.where(sizes > 0.0, gaussians.opacities, 0.0))
    np.testing.assert_allclose(moved.scales[:3], sizes[:3, None] * gaussians.scales[:3], rtol=1e-6)


def test_nearest_rotations_equal_the_singular_value_decomposition():
    """The polar factor by Newton steps equals that of the SVD, also for nearly singular matrices."""
    linear = RNG.standard_normal((300, 3, 3))
    linear[np.linalg.det(linear) < 0.0, 0] *= -1.0
    linear[0] = np.diag([1.0, 1.0, 1e-7])
    left, _, right = np.linalg.svd(linear)
    np.testing.assert_allclose(nearest_rotations(linear), left @ right, atol=1e-6)


def test_rotating_each_function_equals_the_rotation_matrix_of_sh():
    """`rotate_sh` of one function equals the matrix of `sh_rotation`, which another method computes."""
    turns = Rotation.from_quat(RNG.standard_normal((5, 4))).as_matrix()
    sh = RNG.standard_normal((5, 16, 3))
    expected = [sh_rotation(turn, 3) @ one for turn, one in zip(turns, sh, strict=True)]
    np.testing.assert_allclose(rotate_sh(sh, turns), expected, atol=1e-12)


def test_weights_skin_gaussians_as_linear_blend_skinning_does(tmp_path):
    """Means equal those of a skinning loop in float64 that shares no code; the rest pose changes nothing."""
    tube = TubeRig(clips={"bend": BEND})
    rig = ls.avatars.load_rig(tube.write(tmp_path / "tube.glb"))
    means = RNG.uniform(-0.5, 2.5, (40, 3))
    joints = len(rig.surfaces[0].parts[0].nodes)
    weights = RNG.uniform(0.0, 1.0, (40, joints)) ** 4
    bound = ls.bind_gaussians(rig, gaussians=some_gaussians(means), weights=weights)
    shown = bound.at(0.7, "bend")
    rest, world = world_matrices(tube, None, 0.0), world_matrices(tube, "bend", 0.7)
    nodes = rig.surfaces[0].parts[0].nodes
    for row in range(40):
        share = weights[row] / weights[row].sum()
        moved = [w * world[node] @ np.linalg.inv(rest[node]) for w, node in zip(share, nodes, strict=True)]
        matrix = np.sum(moved, axis=0)
        np.testing.assert_allclose(shown.means[row], (matrix @ [*means[row], 1.0])[:3], atol=1e-5)
    still = ls.bind_gaussians(rig, gaussians=bound.gaussians, weights=weights, pose=rig.pose_at(0.7, "bend"))
    np.testing.assert_allclose(still.at(0.7, "bend").means, means, atol=1e-5)


def test_gaussians_on_a_skin_stay_on_it_in_every_pose(tmp_path):
    """Gaussians sampled on the mesh, bound by nearest triangles, move as those bound to their own triangles."""
    rig = ls.avatars.load_rig(TubeRig(clips={"bend": BEND}).write(tmp_path / "tube.glb"))
    own = ls.bind_gaussians(rig, 400)
    bound = ls.bind_gaussians(rig, gaussians=replace(own.gaussians, normals=None))
    expected, found = own.at(0.8), bound.at(0.8)
    np.testing.assert_allclose(found.means, expected.means, atol=1e-5)
    cosines = np.abs(np.einsum("ni,ni->n", present(found.normals), present(expected.normals)))
    assert np.median(cosines) > 0.99 and cosines.min() > 0.8
    lifted = replace(own.gaussians, means=own.gaussians.means + 0.05 * present(own.gaussians.normals))
    above = ls.bind_gaussians(rig, gaussians=lifted).at(0.8)
    gap = np.linalg.norm(above.means - expected.means, axis=1)
    assert np.median(np.abs(gap - 0.05)) < 0.01


def test_the_nearest_triangle_and_point_equal_those_of_a_search_over_all():
    """The nearest points equal those of trimesh on triangles of very different sizes."""
    trimesh = pytest.importorskip("trimesh")
    sphere = trimesh.creation.icosphere(subdivisions=2)
    corners = np.concatenate([sphere.triangles, [[[2.0, -5.0, -5.0], [2.0, 5.0, -5.0], [2.0, 0.0, 9.0]]]])
    points = RNG.uniform(-2.0, 2.5, (300, 3))
    rows, weights = nearest_on_triangles(corners, points)
    found = np.einsum("nk,nki->ni", weights, corners[rows])
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    best = np.full(len(points), np.inf)
    for triangle in mesh.triangles:
        near = trimesh.triangles.closest_point(np.tile(triangle, (len(points), 1, 1)), points)
        best = np.minimum(best, np.linalg.norm(near - points, axis=1))
    np.testing.assert_allclose(np.linalg.norm(found - points, axis=1), best, atol=1e-9)


def two_bones() -> Rig:
    """Returns a skeleton of an upper and a lower arm along x, each 1 long, whose elbow bends by 90 degrees in 1 s."""
    skeleton = Skeleton(
        parents=(None, 0, 1),
        order=(0, 1, 2),
        translations=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        rotations_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)),
        scales=np.ones((3, 3)),
        matrices={},
    )
    turn = np.array([[1.0, 0.0, 0.0, 0.0], [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]])
    bend = Track(1, Channel.ROTATION, Interpolation.LINEAR, np.array([0.0, 1.0]), turn)
    return Rig(skeleton, (), (Clip("bend", (bend,)),))


def test_bones_carry_the_gaussians_around_them():
    """Far from the elbow Gaussians are rigid with their bone; at the elbow both share them; nothing tears."""
    along = np.linspace(0.05, 1.95, 191)
    means = np.stack([along, 0.1 * np.cos(40.0 * along), 0.1 * np.sin(40.0 * along)], axis=1)
    bound = ls.bind_gaussians(two_bones(), gaussians=some_gaussians(means))
    assert isinstance(bound.bindings, JointBinding)
    moved = bound.at(1.0)
    upper, lower = along < 0.8, along > 1.2
    np.testing.assert_allclose(moved.means[upper], means[upper], atol=1e-5)
    elbow, quarter = np.array([1.0, 0.0, 0.0]), Rotation.from_rotvec([0.0, 0.0, np.pi / 2.0])
    np.testing.assert_allclose(moved.means[lower], quarter.apply(means[lower] - elbow) + elbow, atol=1e-5)
    shares = bound.bindings.weights[np.abs(along - 1.0) < 0.02]
    assert (shares[:, :2] > 0.2).all()


def test_a_skeleton_in_other_units_or_elsewhere_is_refused_until_the_advice_is_followed():
    """Metres and centimetres, a place beside the figure, and one on its head: each is named, and `transform` mends it.

    Floaters far away, 1 in 200, do not make the figure larger.
    """
    along = np.linspace(0.0, 2.0, 400)
    means = np.stack([along, 0.1 * np.cos(40.0 * along), 0.1 * np.sin(40.0 * along)], axis=1)
    means[::200] += 70.0
    metres, rig = some_gaussians(means), two_bones()
    expected = ls.bind_gaussians(rig, gaussians=metres)
    changes: list[tuple[dict[str, Any], str]] = [
        ({"scale": 0.01}, r"the skeleton is 101 times as large as the Gaussians \(2 and 0.01985 units\)"),
        ({"scale": 5.0}, r"the skeleton is 0.2\d* times as large as the Gaussians"),
        ({"translation": (0.0, 1.0, 0.0)}, r"the skeleton, in \(0, 0, 0\)..\(2, 0, 0\), stands beside the Gaussians"),
        ({"rotation_degrees": (0.0, 180.0, 0.0)}, "move or turn them by ls.transform"),
    ]
    for change, message in changes:
        moved = ls.transform(metres, **change)
        with pytest.raises(ls.SceneError, match=message):
            ls.bind_gaussians(rig, gaussians=moved)
        back: dict[str, Any] = (
            {"scale": 1.0 / change["scale"]} if "scale" in change else {k: -np.array(v) for k, v in change.items()}
        )
        mended = ls.bind_gaussians(rig, gaussians=ls.transform(moved, **back))
        np.testing.assert_allclose(mended.at(1.0).means, expected.at(1.0).means, atol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"weights": np.ones((4, 5))}, "weights has shape (4, 5), expected (4, 3)"),
        ({"weights": -np.ones((4, 3))}, "weights has -1, expected numbers of at least 0"),
        ({"weights": np.eye(4, 3)}, "weights of Gaussian 3 are all 0"),
        ({"count": 7}, "count is the number of new Gaussians"),
        ({"count": some_gaussians(np.ones((4, 3)))}, "pass given ones as gaussians="),
        ({"pose": 2.0}, "takes a pose of the rig, got a float: rig.pose_at(seconds) makes one"),
    ],
)
def test_bindings_that_do_not_fit_are_refused(arguments, message):
    """A wrong shape, negative or empty weights and a needless count give one line each."""
    with pytest.raises(ls.SceneError) as caught:
        ls.bind_gaussians(two_bones(), gaussians=some_gaussians(np.ones((4, 3))), **arguments)
    assert message in str(caught.value)


def test_weights_without_gaussians_and_a_skeleton_without_any_are_refused():
    """Weights belong to given Gaussians, and a rig without meshes cannot be covered."""
    with pytest.raises(ls.SceneError, match="pass gaussians="):
        ls.bind_gaussians(two_bones(), weights=np.ones((4, 3)))
    with pytest.raises(ls.SceneError, match="no meshes to cover"):
        ls.bind_gaussians(two_bones())


def test_a_rig_of_joints_takes_world_rotations_and_refuses_broken_trees():
    """Joints turn as the given world rotations say; the root moves; a later parent and two roots are refused."""
    joints: dict = {"hip": (None, (0.0, 1.0, 0.0)), "knee": ("hip", (0.0, 0.5, 0.0)), "foot": ("knee", (0.1, 0.0, 0.0))}
    turns = Rotation.from_quat(RNG.standard_normal((2, 3, 4)).reshape(-1, 4))
    wxyz = np.roll(turns.as_quat(), 1, axis=1).reshape(2, 3, 4)
    rig = ls.avatars.Rig.of_joints(joints, [0.0, 2.0], 3.0 * wxyz, [(0.0, 1.0, 0.0), (5.0, 1.0, 0.0)])
    assert (rig.clips, rig.duration()) == (("motion",), 2.0)
    world = rig.pose_at(2.0).world_from_node
    np.testing.assert_allclose(world[:, :3, :3], turns.as_matrix()[3:], atol=1e-12)
    knee = turns[3].apply([0.0, -0.5, 0.0]) + np.array([5.0, 1.0, 0.0])
    np.testing.assert_allclose(world[2, :3, 3], turns[4].apply([0.1, -0.5, 0.0]) + knee, atol=1e-12)
    still = ls.avatars.Rig.of_joints(joints)
    np.testing.assert_allclose(still.pose_at(0.0).world_from_node[:, :3, 3], [at for _, at in joints.values()])
    with pytest.raises(ls.SceneError, match="joint 'knee' has the parent 'toe', expected the name of an earlier joint"):
        ls.avatars.Rig.of_joints(joints | {"knee": ("toe", (0, 0, 0))})
    with pytest.raises(ls.SceneError, match="joints have 2 roots"):
        ls.avatars.Rig.of_joints(joints | {"knee": (None, (0, 0, 0))})


@pytest.mark.parametrize(
    ("times", "turns", "places", "message"),
    [
        (None, None, [(0.0, 0.0, 0.0)], "make a clip, with root_positions"),
        ([1.0, 0.0], np.ones((2, 2, 4)), None, "times must increase, but 0 follows 1"),
        ([], np.ones((0, 2, 4)), None, "at least one"),
        ([0.0, 1.0], np.ones((2, 2, 1)) * (0.0, 0.0, 0.0, 0.0), None, "of joint 'hip': 2 of 2 are of zero length"),
    ],
)
def test_a_rig_of_joints_refuses_clips_that_cannot_be_played(times, turns, places, message):
    """Positions without times, times that fall or are none, and rotations that are none give one line each."""
    joints: dict = {"hip": (None, (0.0, 1.0, 0.0)), "knee": ("hip", (0.0, 0.5, 0.0))}
    with pytest.raises(ls.SceneError, match=message):
        ls.avatars.Rig.of_joints(joints, times, turns, places)


def test_gaussians_of_gaussian_avatars_follow_their_triangles(tmp_path):
    """In every pose a Gaussian is at the scaled local position in its triangle's frame; SH stay in world space."""
    rig = ls.avatars.load_rig(TubeRig(clips={"bend": BEND}).write(tmp_path / "tube.glb"))
    local = some_gaussians(RNG.uniform(-0.3, 0.3, (30, 3)), normals=None)
    faces = RNG.integers(0, len(rig.mesh.indices), 30).astype(np.int32)
    ls.save(tmp_path / "plain.ply", local)
    header, body = (tmp_path / "plain.ply").read_bytes().split(b"end_header\n", 1)
    width = len(body) // 30
    rows = [body[k * width : (k + 1) * width] + faces[k : k + 1].tobytes() for k in range(30)]
    written = header + b"property int binding_0\nend_header\n" + b"".join(rows)
    (tmp_path / "point_cloud.ply").write_bytes(written)
    gaussians, triangles = ls.avatars.load_bound_gaussians(tmp_path / "point_cloud.ply")
    np.testing.assert_array_equal(present(triangles), faces)
    assert ls.avatars.load_bound_gaussians(tmp_path / "plain.ply")[1] is None
    shown = ls.bind_gaussians(rig, gaussians=gaussians, triangles=triangles).at(0.8)
    np.testing.assert_allclose(shown.sh, local.sh, atol=1e-6)
    corners = rig.pose(0.8).positions[rig.mesh.indices].astype(float)
    for k, face in enumerate(faces):
        a, b, c = corners[face]
        edge = (b - a) / np.linalg.norm(b - a)
        normal = np.cross(edge, c - a) / np.linalg.norm(np.cross(edge, c - a))
        across = np.cross(edge, normal)
        size = 0.5 * (np.linalg.norm(b - a) + abs(across @ (c - a)))
        frame = np.stack([edge, normal, across], axis=1)
        np.testing.assert_allclose(shown.means[k], size * frame @ local.means[k] + (a + b + c) / 3.0, atol=1e-5)
        wanted = size**2 * frame @ covariances(local)[k] @ frame.T
        np.testing.assert_allclose(covariances(shown)[k], wanted, atol=1e-5 * np.trace(wanted))
    with pytest.raises(ls.SceneError, match="bound to triangle 9999, but the rig has 240"):
        ls.bind_gaussians(rig, gaussians=gaussians, triangles=np.full(30, 9999))


def test_gaussians_of_a_mesh_of_millimetres_are_visible(tmp_path):
    """A head in metres has triangles with edges of 5 mm: its Gaussians have that size, at rest and in every pose."""
    tube = TubeRig(clips={"bend": BEND})
    tube.nodes[1] = {"name": "root", "children": [2], "scale": [0.01, 0.01, 0.01]}
    rig = ls.avatars.load_rig(tube.write(tmp_path / "small.glb"))
    faces = np.arange(len(rig.mesh.indices))
    edges = rig.mesh.positions[rig.mesh.indices] - rig.mesh.positions[np.roll(rig.mesh.indices, 1, axis=1)]
    size = float(np.median(np.linalg.norm(edges, axis=2)))
    assert 0.001 < size < 0.005
    local = some_gaussians(np.zeros((faces.size, 3)), scales=np.full((faces.size, 3), 0.5))
    bound = ls.bind_gaussians(rig, gaussians=local, triangles=faces)
    for shown in (bound.gaussians, bound.at(0.8)):
        np.testing.assert_array_equal(shown.opacities, local.opacities)
        assert np.median(shown.scales) == pytest.approx(0.5 * size, rel=0.5)


def test_a_triangle_without_area_matters_only_to_gaussians_that_are_bound_to_it(tmp_path):
    """Scanned heads have such triangles: unused ones change nothing, and a used one is named."""
    rig = ls.avatars.load_rig(TubeRig(clips={"bend": BEND}).write(tmp_path / "tube.glb"))
    surface = rig.surfaces[0]
    damaged = replace(rig, surfaces=(replace(surface, indices=np.array([[5, 5, 7], *surface.indices])),))
    local, faces = some_gaussians(RNG.uniform(-0.3, 0.3, (30, 3))), RNG.integers(0, len(surface.indices), 30)
    expected = ls.bind_gaussians(rig, gaussians=local, triangles=faces)
    found = ls.bind_gaussians(damaged, gaussians=local, triangles=faces + 1)
    np.testing.assert_array_equal(found.at(0.8).means, expected.at(0.8).means)
    with pytest.raises(ls.SceneError, match="triangle 0 of the rig has no area in the pose of the Gaussians"):
        ls.bind_gaussians(damaged, gaussians=local, triangles=0 * faces)
