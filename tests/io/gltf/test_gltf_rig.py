"""glTF rigs: poses compared with a float64 reference, rigid motion, morph targets, broken files."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.gltf.meshes import usable_colors
from support.files.gltf_writer import Gltf
from support.files.rig_files import BEND, CARRY, VANISH, TubeRig, quaternion_xyzw
from support.kinds import expect_kind, present
from support.oracles.rig_oracle import posed, world_matrices


def load(rig: TubeRig, folder: Path) -> ls.avatars.Rig:
    """Writes and reads a rig."""
    return ls.avatars.load_rig(rig.write(folder / "tube.glb"))


def random_rig(seed: int) -> TubeRig:
    """Returns a rig with skewed joints, two weight sets, a bind pose, and a clip of all channels and interpolations."""
    rng = np.random.default_rng(seed)
    rig = TubeRig()
    count = len(rig.positions)
    rig.joints = rng.integers(0, 3, (count, 8), dtype=np.uint8)
    rig.weights = np.where(rng.random((count, 8)) < 0.4, 0.0, rng.random((count, 8))).astype(np.float32)
    rig.weights[:, 0] += 0.1
    rig.joint_from_bind = (np.eye(4) + 0.2 * rng.standard_normal((3, 4, 4))).astype(np.float32)
    rig.joint_from_bind[:, 3] = (0.0, 0.0, 0.0, 1.0)
    for node in rig.nodes[1:]:
        node["rotation"] = quaternion_xyzw(tuple(rng.standard_normal(3)), rng.uniform(-90.0, 90.0))
        node["scale"] = rng.uniform(0.5, 1.5, 3).tolist()
        node["translation"] = rng.standard_normal(3).tolist()
    tracks = []
    for node in (1, 2, 3, 4):
        for path, width in (("translation", 3), ("rotation", 4), ("scale", 3)):
            interpolation = str(rng.choice(["LINEAR", "STEP", "CUBICSPLINE"]))
            times = np.cumsum(rng.uniform(0.1, 0.6, 5)).astype(np.float32)
            values = rng.standard_normal((5, width))
            if path == "rotation":
                values /= np.linalg.norm(values, axis=1, keepdims=True)
            elif path == "scale":
                values = np.abs(values) + 0.3
            if interpolation == "CUBICSPLINE":
                values = np.stack([rng.standard_normal((5, width)), values, rng.standard_normal((5, width))], 1)
            tracks.append((node, path, times, values.reshape(-1, width).astype(np.float32), interpolation))
    rig.clips["all"] = tracks
    return rig


def test_rig_in_bind_pose_reproduces_the_mesh_of_the_file(tmp_path: Path) -> None:
    """Vertices and normals are equal to float32 precision."""
    rig = TubeRig(clips={"bend": BEND})
    loaded = load(rig, tmp_path)
    assert loaded.clips == ("bend",) and loaded.duration() == 1.0
    for mesh in (loaded.mesh, loaded.pose(0.0)):
        np.testing.assert_allclose(mesh.positions, rig.positions, atol=1e-6)
        np.testing.assert_allclose(present(mesh.normals), present(rig.normals), atol=1e-6)
        np.testing.assert_array_equal(mesh.indices, rig.triangles)
    assert loaded.mesh.material.base_color == pytest.approx((0.8, 0.4, 0.2))


def test_rig_whose_root_joint_alone_is_animated_moves_rigidly(tmp_path: Path) -> None:
    """All vertices and normals have the transform of the root."""
    rig = TubeRig(clips={"carry": CARRY})
    loaded = load(rig, tmp_path)
    for time in (0.3, 1.0, 1.9):
        root = world_matrices(rig, "carry", time)[1]
        mesh = loaded.pose(time)
        np.testing.assert_allclose(mesh.positions, rig.positions @ root[:3, :3].T + root[:3, 3], atol=2e-6)
        np.testing.assert_allclose(present(mesh.normals), present(rig.normals) @ root[:3, :3].T, atol=2e-6)


@pytest.mark.parametrize("seed", range(4))
def test_rig_poses_match_a_float64_reference(seed: int, tmp_path: Path) -> None:
    """The rig animates every channel with every interpolation, and a vertex has eight influences."""
    rig = random_rig(seed)
    loaded = load(rig, tmp_path)
    for time in (-1.0, 0.0, *np.linspace(0.05, loaded.duration("all"), 13), 99.0):
        positions, normals = posed(rig, "all", float(time))
        mesh = loaded.pose(float(time), "all")
        np.testing.assert_allclose(mesh.positions, positions, atol=1e-5 * np.abs(positions).max())
        # Nearly singular joint matrices amplify the float32 rounding of normals.
        np.testing.assert_allclose(present(mesh.normals), normals, atol=2e-4)


def test_rest_pose_of_a_rig_equals_the_mesh_that_load_returns(tmp_path: Path) -> None:
    """The poses are equal even if a node mirrors the mesh."""
    rig = random_rig(7)
    rig.nodes[1]["scale"] = [-1.0, 1.0, 1.0]
    loaded = load(rig, tmp_path)
    shown = expect_kind(ls.Scene, ls.load(tmp_path / "tube.glb")).meshes[0].mesh
    np.testing.assert_allclose(loaded.mesh.positions, shown.positions, atol=1e-5)
    np.testing.assert_allclose(present(loaded.mesh.normals), present(shown.normals), atol=1e-5)
    np.testing.assert_array_equal(loaded.mesh.indices, shown.indices)


def test_mirrored_rigs_have_outward_triangles_and_normals(tmp_path: Path) -> None:
    """A mirroring root node reverses triangles and normals."""
    rig = TubeRig()
    rig.nodes[1]["scale"] = [-1.0, 1.0, 1.0]
    mesh = load(rig, tmp_path).mesh
    a, b, c = mesh.positions[mesh.indices].swapaxes(0, 1)
    faces = np.cross(b - a, c - a)
    outwards = (a + b + c) * (1.0, 0.0, 1.0)
    assert ((faces * outwards).sum(axis=1) > 0.0).all()
    assert ((present(mesh.normals) * mesh.positions)[:, [0, 2]].sum(axis=1) > 0.0).all()


def test_rig_without_a_skin_follows_its_animated_node(tmp_path: Path) -> None:
    """A mesh that only its node moves is a rig, too."""
    rig = TubeRig(joints=None, weights=None, clips={"go": [(0, *CARRY[0][1:]), (0, *CARRY[1][1:])]})
    del rig.nodes[0]["skin"]
    loaded = load(rig, tmp_path)
    node = world_matrices(rig, "go", 1.3)[0]
    np.testing.assert_allclose(loaded.pose(1.3).positions, rig.positions @ node[:3, :3].T + node[:3, 3], atol=2e-6)


def test_animated_morph_targets_deform_a_rig_before_skinning(tmp_path: Path) -> None:
    """Without a clip, the weights stored in the mesh are used."""
    rng = np.random.default_rng(3)
    rig = TubeRig()
    rig.targets = list(rng.standard_normal((2, *rig.positions.shape)).astype(np.float32))
    rig.clips["talk"] = [(0, "weights", [0.0, 1.0], np.array([0.0, 1.0, 1.0, 0.5], np.float32))]
    loaded = load(rig, tmp_path)
    np.testing.assert_allclose(loaded.mesh.positions, rig.positions, atol=1e-6)
    wanted = rig.positions + 0.25 * rig.targets[0] + 0.875 * rig.targets[1]
    np.testing.assert_allclose(loaded.pose(0.25).positions, wanted, atol=1e-6)


def test_morph_targets_without_position_offsets_still_have_an_animated_weight(tmp_path: Path) -> None:
    """The second target has only tangents, but still a weight in the animation."""
    rig = TubeRig(clips={"melt": [(0, "weights", [0, 1], [0.0, 0.0, 1.0, 1.0])]}, normals=None)
    rig.targets = [np.full_like(rig.positions, 0.5)]
    gltf = rig.gltf()
    tangents = gltf.accessor(np.zeros_like(rig.positions))
    gltf.json["meshes"][0]["primitives"][0]["targets"].append({"TANGENT": tangents})
    (tmp_path / "tube.glb").write_bytes(gltf.glb())
    (posed,) = ls.avatars.load_rig(tmp_path / "tube.glb").poses(1.0)
    np.testing.assert_allclose(posed.positions, rig.positions + 0.5, atol=1e-5)


def two_primitives(rig: TubeRig, same_material: bool) -> Gltf:
    """Returns the tube twice in one mesh, the copy without its first triangle."""
    gltf = rig.gltf()
    first = gltf.json["meshes"][0]["primitives"][0]
    material = 0 if same_material else gltf.add("materials", name="other")
    less = gltf.accessor(rig.triangles[1:].reshape(-1))
    gltf.json["meshes"][0]["primitives"].append({**first, "indices": less, "material": material})
    return gltf


def test_rig_primitives_with_equal_material_are_joined_to_one_mesh(tmp_path: Path) -> None:
    """Primitives with different materials are separate meshes, which `poses` returns and `pose` refuses."""
    rig = TubeRig(clips={"bend": BEND})
    count, faces = len(rig.positions), len(rig.triangles)
    (tmp_path / "one.glb").write_bytes(two_primitives(rig, True).glb())
    one = ls.avatars.load_rig(tmp_path / "one.glb").pose(0.5)
    assert (one.vertex_count, one.face_count) == (2 * count, 2 * faces - 1)
    np.testing.assert_array_equal(one.positions[:count], one.positions[count:])
    (tmp_path / "two.glb").write_bytes(two_primitives(rig, False).glb())
    two = ls.avatars.load_rig(tmp_path / "two.glb")
    assert [mesh.material.name for mesh in two.poses(0.5)] == ["skin", "other"]
    assert [mesh.face_count for mesh in two.meshes] == [faces, faces - 1]
    with pytest.raises(ls.SceneError, match=r"2 meshes of different materials: use rig\.poses\(time\)"):
        two.pose(0.5)
    with pytest.raises(ls.SceneError, match=r"use rig\.meshes"):
        _ = two.mesh


def test_rig_has_no_meshes_at_times_when_its_clip_scales_it_to_zero(tmp_path: Path) -> None:
    """`poses` returns an empty tuple, and `pose` raises an error."""
    loaded = load(TubeRig(clips={"vanish": VANISH}), tmp_path)
    assert loaded.poses(1.0) == ()
    with pytest.raises(ls.SceneError, match="no triangles at 1 s: its clip scales it to zero"):
        loaded.pose(1.0)


def test_all_poses_of_a_rig_share_one_triangle_array(tmp_path: Path) -> None:
    """Shadow maps recognize a surface by its array, even if degenerate triangles were dropped from the mesh."""
    rig = TubeRig(clips={"bend": BEND})
    rig.triangles = np.concatenate([rig.triangles, np.array([[0, 0, 1]], np.uint16)])
    read = load(rig, tmp_path)
    early, late = read.pose(0.25), read.pose(0.75)
    assert len(early.indices) == len(rig.triangles) - 1
    assert early.indices is late.indices


def test_rig_meshes_hidden_at_rest_are_dropped_with_a_log_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A node scale of 0 hides a mesh; a rig without any other mesh is refused."""
    rig = TubeRig(clips={"bend": BEND})
    rig.nodes.append({"mesh": 0, "name": "hidden", "scale": [0.0, 0.0, 0.0]})
    gltf = rig.gltf()
    alone = {**gltf.json["meshes"][0]["primitives"][0], "material": gltf.add("materials", name="other")}
    gltf.json["nodes"][-1]["mesh"] = gltf.add("meshes", primitives=[alone], name="hat")
    (tmp_path / "two.glb").write_bytes(gltf.glb())
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert ls.avatars.load_rig(tmp_path / "two.glb").mesh.material.name == "skin"
    assert "mesh 'hat' left out: at rest it has no triangles with an area" in caplog.text
    rig.nodes[1]["scale"] = [0.0, 0.0, 0.0]
    with pytest.raises(ls.FormatError, match="has no triangles with an area at rest"):
        load(rig, tmp_path)


def test_rig_clips_are_chosen_by_name_and_default_to_the_first(tmp_path: Path) -> None:
    """An unknown name is refused with a list of the clips."""
    loaded = load(TubeRig(clips={"bend": BEND, "carry": CARRY}), tmp_path)
    assert loaded.duration("carry") == 2.0
    np.testing.assert_array_equal(loaded.pose(0.5).positions, loaded.pose(0.5, "bend").positions)
    assert np.abs(loaded.pose(0.5).positions - loaded.pose(0.5, "carry").positions).max() > 0.1
    with pytest.raises(ls.SceneError, match="the rig has no clip 'run', it has 'bend', 'carry'"):
        loaded.pose(0.0, "run")
    for time in (np.nan, np.inf, cast(Any, "now")):
        with pytest.raises(ls.SceneError, match="time is"):
            loaded.pose(time)


def test_rigs_without_clips_stay_in_the_rest_pose(tmp_path: Path) -> None:
    """Any time gives the rest pose; asking for the duration is an error."""
    loaded = load(TubeRig(), tmp_path)
    np.testing.assert_array_equal(loaded.pose(5.0).positions, loaded.mesh.positions)
    with pytest.raises(ls.SceneError, match="the rig has no clips"):
        loaded.duration()


def without_skin(rig: TubeRig) -> None:
    """Removes the skin and the weights."""
    del rig.nodes[0]["skin"]
    rig.joints = rig.weights = None


def keys(rig: TubeRig, path: str, times: list, values: list, interpolation: str = "LINEAR", node: int = 3) -> None:
    """Gives the rig one clip with a single animated channel."""
    rig.clips["clip"] = [(node, path, times, values, interpolation)]


def unweighted(rig: TubeRig, value: float) -> None:
    """Replaces all weights of two vertices."""
    present(rig.weights)[[3, 5]] = value


def broken_bind(rig: TubeRig) -> None:
    """Makes an inverse bind matrix non-finite."""
    rig.joint_from_bind = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    rig.joint_from_bind[1, 0, 0] = np.nan


NAN, VALUES = float("nan"), [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
BROKEN = [
    (without_skin, "is not a rig: it has neither a skin nor an animation"),
    (lambda rig: setattr(rig, "joints", None), "has no skin weights: expected JOINTS_0 and WEIGHTS_0"),
    (lambda rig: setattr(rig, "weights", None), "needs JOINTS_0 and WEIGHTS_0 for each vertex"),
    (lambda rig: unweighted(rig, 0.0), "is skinned, but 2 vertices have no weight"),
    (lambda rig: unweighted(rig, NAN), "2 vertices have skin weights that are negative or not finite"),
    (lambda rig: unweighted(rig, -1.0), "2 vertices have skin weights that are negative or not finite"),
    (lambda rig: present(rig.joints).__setitem__((0, 0), 9), "uses joint 9, but its skin has 3"),
    (broken_bind, "skins[0]: 1 of 3 inverse bind matrices are not finite"),
    (lambda rig: keys(rig, "translation", [0, 1], [[0, 0, NAN], [NAN, 0, 0]]), "2 of 6 key values are not finite"),
    (lambda rig: keys(rig, "translation", [0, NAN], VALUES), "1 of 2 key times are not finite"),
    (lambda rig: keys(rig, "translation", [1, 0], VALUES), "key times must increase, but 0 follows 1 s"),
    (lambda rig: keys(rig, "translation", [0, 1, 2], VALUES), "has 2 values for 3 keys, expected 3"),
    (lambda rig: keys(rig, "scale", [0, 1], VALUES, "CUBICSPLINE"), "has 2 values for 2 keys, expected 6"),
    (lambda rig: keys(rig, "scale", [0, 1], VALUES, "QUINTIC"), "expected one of STEP, LINEAR, CUBICSPLINE"),
    (lambda rig: keys(rig, "rotation", [0], [[0.0, 0.0, 0.0, 0.0]]), "1 rotations have zero length"),
    (lambda rig: keys(rig, "rotation", [0], [[0.0, 0.0, 0.0]]), "expected VEC4"),
    (lambda rig: keys(rig, "scale", [0, 1], VALUES, node=77), "refers to nodes[77]"),
    (lambda rig: keys(rig, "weights", [0], [[1.0]][0], node=0), "a mesh without morph targets"),
]  # fmt: skip


@pytest.mark.parametrize(("breaks", "problem"), BROKEN, ids=[problem[:40] for _, problem in BROKEN])
def test_error_for_an_invalid_rig_names_the_file_and_the_invalid_item(
    breaks: Callable[[TubeRig], None], problem: str, tmp_path: Path
) -> None:
    """The one-line error names the file and the glTF item, and counts non-finite values."""
    rig = TubeRig()
    breaks(rig)
    with pytest.raises(ls.FormatError) as caught:
        load(rig, tmp_path)
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "tube.glb")) and "\n" not in message
    assert problem in message


def test_rigs_with_random_byte_changes_either_are_refused_or_can_be_posed(tmp_path: Path) -> None:
    """A refusal is one line."""
    rng = np.random.default_rng(0)
    data = TubeRig(clips={"bend": BEND, "carry": CARRY}).gltf().glb()
    refused = 0
    for _ in range(80):
        damaged = bytearray(data)
        for at in rng.integers(20, len(damaged), 3):
            damaged[at] = rng.integers(0, 256)
        (tmp_path / "tube.glb").write_bytes(bytes(damaged))
        try:
            loaded = ls.avatars.load_rig(tmp_path / "tube.glb")
            for clip in loaded.clips:
                loaded.poses(0.4, clip)
        except ls.FormatError as error:
            assert "\n" not in str(error)
            refused += 1
        except ls.SceneError as error:  # a pose beyond float32
            assert "non-finite" in str(error)
    assert 10 < refused < 80


def test_load_rig_refuses_files_of_unknown_extensions_without_parsing(tmp_path: Path) -> None:
    """Upper-case extensions are allowed."""
    (tmp_path / "spot.obj").write_text("v 0 0 0\n")
    with pytest.raises(
        ls.FormatError, match=r"spot\.obj: unknown extension '\.obj' of a rig, expected \.glb, \.gltf, \.vrm, or \.npz"
    ):
        ls.avatars.load_rig(tmp_path / "spot.obj")
    assert ls.avatars.load_rig(TubeRig(clips={"bend": BEND}).write(tmp_path / "TUBE.GLB")).clips == ("bend",)


def test_gltf_animation_of_a_node_that_has_a_matrix_is_refused(tmp_path: Path) -> None:
    """Only translation, rotation and scale can be animated."""
    rig = TubeRig(clips={"bend": BEND})
    rig.nodes[3] = {"children": [4], "matrix": np.eye(4).reshape(-1).tolist()}
    with pytest.raises(ls.FormatError, match=r"animates nodes\[3\], which has a matrix"):
        load(rig, tmp_path)


def test_black_vertex_colours_are_dropped_from_textured_meshes_and_kept_on_others(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Black colours on a texture are masks; other colours stay, and so do black colours of meshes without a texture."""
    texture = np.zeros((2, 2, 3), np.uint8)
    plain, textured = ls.MaterialPbr(), ls.MaterialPbr(base_color_texture=texture)
    black, gray = np.zeros((4, 3), np.float32), np.full((4, 3), 0.2, np.float32)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert usable_colors("a.glb", gray, textured, "head", "export it") is gray and not caplog.records
        assert usable_colors("a.glb", black, textured, "head", "export it") is None
        assert usable_colors("a.glb", black, plain, "head", "export it") is black
    left_out, used = (record.getMessage() for record in caplog.records)
    assert left_out.endswith("'head' black: the mesh has a texture, and COLOR_0 is left out")
    assert used.endswith("'head' black: if it is no colour, export it")


def test_rig_with_black_vertex_colours_stays_black_with_a_warning_unless_vertex_colors_is_false(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Vertex colours multiply the base colour, as glTF demands, so the mesh is black."""
    rig = TubeRig()
    rig.attributes["COLOR_0"] = np.zeros((len(rig.positions), 4), np.float32)
    path = rig.write(tmp_path / "tube.glb")
    with caplog.at_level(logging.WARNING, "lumisplat"):
        assert not present(ls.avatars.load_rig(path).mesh.colors).any()
    assert "COLOR_0 makes 100 % of the vertices of 'tube' black" in caplog.text
    caplog.clear()
    assert ls.avatars.load_rig(path, vertex_colors=False).mesh.colors is None
    assert not caplog.records
    ls.load(path)
    assert "COLOR_0 makes 100 % of the vertices of 'tube' black" in caplog.text


@pytest.mark.data
def test_last_pose_of_the_downloaded_walk_cycle_equals_the_first(data_dir: Path) -> None:
    """Its rest pose equals the mesh that `load` returns."""
    path = data_dir / "avatars" / "walk.glb"
    rig = ls.avatars.load_rig(path, vertex_colors=False)
    assert len(rig.clips) == 1
    assert rig.duration() == pytest.approx(29.0 / 30.0)
    first, middle, last = (rig.pose(fraction * rig.duration()).positions for fraction in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(first, last, atol=1e-5)
    assert 0.02 < np.abs(middle - first).max() < 0.2
    shown = expect_kind(ls.Scene, ls.load(path)).meshes[0].mesh
    np.testing.assert_allclose(rig.mesh.positions, shown.positions, atol=1e-6)
    np.testing.assert_allclose(present(rig.mesh.normals), present(shown.normals), atol=1e-6)
