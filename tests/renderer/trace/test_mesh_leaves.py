"""Leaves of the BVHs of meshes, which hold up to eight triangles, and rays in instances that are only moved."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import NODE_WIDTH
from lumisplat.renderer.scene import device_scene
from lumisplat.renderer.scene.instance_tables import mesh_instance_table
from lumisplat.renderer.trees.mesh_bvh import TriangleTrees
from lumisplat.runtime.launcher import Launcher
from support.scenes.raster_scenes import similarity
from support.scenes.ray_rig import RayRig


def soup(seed: int, count: int) -> ls.Mesh:
    """Returns triangles of random size in a box."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1.0, 1.0, (count, 1, 3)) + 0.1 * rng.normal(size=(count, 3, 3))
    return ls.Mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


@pytest.mark.parametrize("parallel", [False, True])
def test_each_triangle_is_in_one_lane_of_one_leaf_inside_the_box_of_the_leaf(parallel: bool) -> None:
    """Meshes of one leaf, of a few and of many are built together; unused lanes are marked."""
    meshes = [soup(seed, count) for seed, count in enumerate((1, 8, 9, 700))]
    trees = TriangleTrees(Launcher("cpu", 1, parallel=parallel), meshes)
    nodes, leaves = trees.nodes.numpy(), trees.leaves.numpy()
    assert sorted(~nodes["link"][nodes["link"] < 0]) == list(range(len(leaves)))
    found = []
    for root, mesh in enumerate(meshes):
        waiting, faces = [root], []
        while waiting:
            node = nodes[waiting.pop()]
            for lane, link in enumerate(node["link"]):
                if 0 <= link < len(nodes):
                    waiting.append(link)
                elif link < 0:
                    leaf = leaves[~link]
                    used = np.flatnonzero(leaf["face"] >= 0)
                    found.append(len(used))
                    corners = mesh.positions[mesh.indices[leaf["face"][used]]]
                    stored = np.array([[leaf[f"{corner}_{axis}"][used] for axis in "xyz"] for corner in "abc"])
                    np.testing.assert_array_equal(np.moveaxis(stored, 2, 0), corners.astype(np.float32))
                    for k, axis in enumerate("xyz"):
                        assert node[f"low_{axis}"][lane] <= corners[..., k].min()
                        assert node[f"high_{axis}"][lane] >= corners[..., k].max()
                    faces += list(leaf["face"][used])
        assert sorted(faces) == list(range(mesh.face_count))
    assert max(found) <= NODE_WIDTH and found[:2] == [1, 8]
    assert np.mean(found) > 0.4 * NODE_WIDTH, "leaves are well filled"


def test_hits_in_moved_instances_equal_those_of_transformed_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    """An instance without rotation keeps directions; without the mark, its rays are transformed, to the same bits."""
    rng = np.random.default_rng(1)
    poses = [similarity(offset=tuple(offset)) for offset in rng.normal(0.0, 0.5, (4, 3))]
    turned = similarity((1.0, 0.5, 0.2), 0.7, 1.1, (0.2, 0.0, 0.1))
    scene = ls.Scene([], [ls.MeshInstance(soup(2, 60), pose) for pose in (*poses, turned)])
    along = rng.normal(size=(2000, 3))
    rays = rng.normal(0.0, 1.0, (2000, 3)), along / np.linalg.norm(along, axis=1, keepdims=True)
    kept = RayRig("cpu", 1).hits(scene, *rays)
    marks: list[int] = []

    def unmarked(*inputs: Any) -> np.ndarray:
        table = mesh_instance_table(*inputs)
        marks.extend(table["keeps_directions"])
        table["keeps_directions"] = 0
        return table

    monkeypatch.setattr(device_scene, "mesh_instance_table", unmarked)
    transformed = RayRig("cpu", 1).hits(scene, *rays)
    assert marks == [1, 1, 1, 1, 0] and (kept.face >= 0).mean() > 0.1
    for name in ("t", "face", "instance", "weights"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(transformed, name))
