"""Gaussians bound to a rig follow rigid and affine motion exactly, without holes, flips or flicker."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from support.files.rig_files import BEND, CARRY, VANISH, TubeRig, tube
from support.kinds import present
from support.oracles.rig_oracle import posed, world_matrices

COUNT = 1500


def covariances(gaussians: ls.Gaussians, thin: bool = True) -> np.ndarray:
    """Returns covariances, shape (N, 3, 3); without ``thin``, only of the two wide axes of each disc."""
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_quat(np.roll(gaussians.rotations_wxyz.astype(float), -1, axis=1)).as_matrix()
    axes = axes * gaussians.scales.astype(float)[:, None, :]
    axes = axes if thin else axes[:, :, :2]
    return axes @ axes.transpose(0, 2, 1)


def bound(rig: TubeRig, folder, count: int = COUNT) -> ls.RiggedGaussians:
    """Writes a rig, reads it, and binds Gaussians to it."""
    return ls.bind_gaussians(ls.avatars.load_rig(rig.write(folder / "tube.glb")), count)


def affine_rig(matrix: np.ndarray) -> TubeRig:
    """Returns a rig without normals whose clip rotates, scales and rotates again, as nested nodes."""
    left, factors, right = np.linalg.svd(matrix)
    if np.linalg.det(left) < 0.0:
        left[:, 2], right[2] = -left[:, 2], -right[2]
    from scipy.spatial.transform import Rotation

    rig = TubeRig(normals=None)
    rig.nodes[1] = {"name": "left", "children": [2]}
    rig.nodes[2] = {"name": "hip", "children": [3]}
    rig.joints = np.zeros_like(rig.joints)
    turns = {1: Rotation.from_matrix(left).as_quat(), 2: Rotation.from_matrix(right).as_quat()}
    whole = [0.0, 0.0, 0.0, 1.0]
    rig.clips["map"] = [(node, "rotation", [0.0, 1.0], [whole, turn]) for node, turn in turns.items()]
    rig.clips["map"].append((1, "scale", [0.0, 1.0], [[1.0, 1.0, 1.0], factors]))
    return rig


def test_rigged_gaussians_at_rest_equal_gaussians_from_the_mesh(tmp_path):
    """Means, shapes and normals at rest equal those of `gaussians_from_mesh`, and colours are the same arrays."""
    rigged = bound(TubeRig(clips={"bend": BEND}), tmp_path)
    alone = ls.gaussians_from_mesh(rigged.rig.mesh, COUNT)
    np.testing.assert_array_equal(rigged.gaussians.means, alone.means)
    np.testing.assert_array_equal(rigged.gaussians.scales, alone.scales)
    shown = rigged.at(0.0)
    assert shown.sh is rigged.gaussians.sh and shown.albedo is rigged.gaussians.albedo
    assert shown.opacities is rigged.gaussians.opacities
    np.testing.assert_allclose(shown.means, alone.means, atol=1e-6)
    np.testing.assert_allclose(present(shown.normals), present(alone.normals), atol=1e-5)
    largest = alone.scales.max() ** 2
    np.testing.assert_allclose(covariances(shown), covariances(alone), atol=1e-5 * largest)


def test_rigid_motion_of_a_rig_moves_its_gaussians_rigidly(tmp_path):
    """If the whole rig moves rigidly, means, covariances and normals move rigidly."""
    rig = TubeRig(clips={"carry": CARRY})
    rigged = bound(rig, tmp_path)
    root = world_matrices(rig, "carry", 1.2)[1]
    rest, shown = rigged.gaussians, rigged.at(1.2)
    turn = root[:3, :3]
    np.testing.assert_allclose(shown.means, rest.means @ turn.T + root[:3, 3], atol=3e-6)
    np.testing.assert_allclose(present(shown.normals), present(rest.normals) @ turn.T, atol=1e-5)
    np.testing.assert_allclose(
        covariances(shown), turn @ covariances(rest) @ turn.T, atol=1e-5 * rest.scales.max() ** 2
    )


@pytest.mark.parametrize("seed", range(3))
def test_disc_gaussians_of_a_stretched_or_sheared_rig_become_the_exact_ellipses(seed, tmp_path):
    """Under stretch and shear, the wide axes span the mapped ellipse, and the thin axis is perpendicular to it."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(3) + 0.4 * rng.standard_normal((3, 3))
    matrix[:, 0] *= np.sign(np.linalg.det(matrix))
    rigged = bound(affine_rig(matrix), tmp_path)
    rest, shown = rigged.gaussians, rigged.at(1.0)
    np.testing.assert_allclose(shown.means, rest.means @ matrix.T, atol=1e-5)
    wanted = matrix @ covariances(rest, thin=False) @ matrix.T
    size = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    assert (np.abs(covariances(shown, thin=False) - wanted) / size).max() < 1e-4
    area = np.sqrt(shown.scales[:, :2].prod(axis=1) / rest.scales[:, :2].prod(axis=1))
    np.testing.assert_allclose(shown.scales[:, 2], rest.scales[:, 2] * area, rtol=1e-4)


def face_normals(rigged: ls.RiggedGaussians, time: float | None = None) -> np.ndarray:
    """Returns the normal of the triangle under each Gaussian, shape (N, 3)."""
    mesh = rigged.rig.mesh if time is None else rigged.rig.pose(time)
    assert isinstance(rigged.bindings, tuple)
    binding = rigged.bindings[0]
    a, b, c = mesh.positions.astype(float)[binding.corners[binding.triangles]].swapaxes(0, 1)
    cross = np.cross(b - a, c - a)
    return cross / np.linalg.norm(cross, axis=1, keepdims=True)


def test_gaussians_of_a_posed_rig_keep_their_barycentric_coordinates(tmp_path):
    """In a bent pose, each mean is the barycentric mean of the oracle's posed triangle vertices."""
    rig = TubeRig(clips={"bend": BEND})
    rigged = bound(rig, tmp_path)
    positions, _ = posed(rig, "bend", 0.8)
    assert isinstance(rigged.bindings, tuple)
    binding = rigged.bindings[0]
    corners = positions[binding.corners[binding.triangles]]
    wanted = np.einsum("nk,nkj->nj", binding.weights.astype(float), corners)
    np.testing.assert_allclose(rigged.at(0.8).means, wanted, atol=2e-6)


def test_discs_of_a_bent_rig_lie_in_the_surface_and_face_outwards(tmp_path):
    """In a bent pose, thin axes and normals point out of the surface; no disc is flipped or perpendicular."""
    rig = TubeRig(clips={"bend": BEND})
    rigged = bound(rig, tmp_path)
    shown, outwards = rigged.at(1.0), face_normals(rigged, 1.0)
    w, x, y, z = shown.rotations_wxyz.T
    thin = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    assert (thin * outwards).sum(axis=1).min() > 0.8
    assert (shown.normals * outwards).sum(axis=1).min() > 0.8
    assert rigged.at(1.0).count == COUNT


def test_gaussians_of_a_bent_rig_leave_no_holes_in_its_surface(tmp_path):
    """In a bent pose, from four sides, the Gaussians are opaque wherever the inner part of the mesh is."""
    rigged = bound(TubeRig(clips={"bend": BEND}), tmp_path, 4000)
    mesh = rigged.rig.pose(1.0)
    renderer = ls.create_renderer(ls.RenderConfig(background=(0.0, 0.0, 0.0)), "cpu")
    center = 0.5 * (mesh.positions.min(axis=0) + mesh.positions.max(axis=0))
    for eye in ((0, 0, 6), (6, 0, 0), (0, 0, -6), (-6, 0, 0)):
        camera = ls.Camera.look_at(center + eye, center, (0, 1, 0), width=160, height=160, fov_y=0.6)
        inside = renderer.render(ls.Scene(meshes=[mesh]), camera).alpha > 0.5
        for axis in (0, 1):
            inside &= np.roll(inside, 2, axis) & np.roll(inside, -2, axis)
        alpha = renderer.render(ls.Scene(splats=[rigged.at(1.0)]), camera).alpha
        assert inside.sum() > 300
        assert alpha[inside].min() > 0.9


def test_gaussians_of_a_rig_scaled_to_zero_become_transparent(tmp_path):
    """Gaussians of a rig that is scaled to zero have opacity 0; their number stays."""
    rigged = bound(TubeRig(clips={"vanish": VANISH}), tmp_path)
    half = rigged.at(0.5)
    np.testing.assert_allclose(half.scales, 0.5 * rigged.gaussians.scales, rtol=1e-4)
    assert half.opacities is rigged.gaussians.opacities
    gone = rigged.at(1.0)
    assert gone.count == COUNT and not gone.opacities.any()


def test_rigged_gaussians_at_equal_times_have_identical_arrays(tmp_path):
    """The same time gives identical arrays, and so does any time after the end."""
    rigged = bound(TubeRig(clips={"bend": BEND}), tmp_path)
    for time in (0.4, 5.0):
        first, second = rigged.at(time), rigged.at(time if time < 1.0 else 9.0)
        for name, values in first.arrays().items():
            np.testing.assert_array_equal(values, getattr(second, name), err_msg=name)


def test_number_of_gaussians_bound_to_a_rig_is_the_total_over_all_its_meshes(tmp_path):
    """A rig with two materials gets exactly the requested Gaussians, each with the colour of its material."""
    gltf = TubeRig(clips={"bend": BEND}).gltf()
    first = gltf.json["meshes"][0]["primitives"][0]
    black = gltf.add("materials", pbrMetallicRoughness={"baseColorFactor": [0.0, 0.0, 0.0, 1.0]})
    few = gltf.accessor(tube()[2][:60].reshape(-1))
    gltf.json["meshes"][0]["primitives"].append({**first, "indices": few, "material": black})
    (tmp_path / "two.glb").write_bytes(gltf.glb())
    rigged = ls.bind_gaussians(ls.avatars.load_rig(tmp_path / "two.glb"), 1201)
    assert rigged.count == rigged.at(0.3).count == 1201
    dark = (rigged.gaussians.albedo == 0.0).all(axis=1).mean()
    assert dark == pytest.approx(60 / (len(tube()[2]) + 60), abs=0.01)


@pytest.mark.parametrize("count", [0, -5, 2.5, True, 10**9])
def test_bind_gaussians_refuses_an_impossible_number_of_gaussians(count, tmp_path):
    """A count must be a whole number that fits into memory."""
    rig = ls.avatars.load_rig(TubeRig().write(tmp_path / "tube.glb"))
    with pytest.raises(ls.SceneError, match="count is"):
        ls.bind_gaussians(rig, count)


def test_bind_gaussians_refuses_a_mesh_without_a_rig(tmp_path):
    """A mesh is refused, since it is not a rig."""
    rig = ls.avatars.load_rig(TubeRig().write(tmp_path / "tube.glb"))
    with pytest.raises(ls.SceneError, match="takes a Rig of load_rig, got a Mesh"):
        ls.bind_gaussians(rig.mesh)  # pyright: ignore[reportArgumentType]


@pytest.mark.data
def test_gaussians_of_a_walking_avatar_stay_within_its_bounds_and_face_outwards(data_dir):
    """Throughout its clip, the real avatar keeps all Gaussians, on the posed mesh and facing outwards."""
    rigged = ls.bind_gaussians(ls.avatars.load_rig(data_dir / "avatars" / "walk.glb", vertex_colors=False), 5000)
    for time in np.linspace(0.0, rigged.rig.duration(), 5):
        shown = rigged.at(float(time))
        assert shown.count == 5000
        low, high = rigged.rig.pose(float(time)).bounds()
        assert (shown.means >= low - 1e-4).all() and (shown.means <= high + 1e-4).all()
        facing = (shown.normals * face_normals(rigged, float(time))).sum(axis=1)
        assert np.quantile(facing, 0.01) > 0.5
