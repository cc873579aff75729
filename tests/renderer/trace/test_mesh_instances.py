"""Thousands of mesh instances: the top-level tree as built, refitted and rebuilt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer.trees.mesh_bvh import MeshBvhScene
from lumisplat.runtime.buffers import device_array
from lumisplat.runtime.launcher import Launcher
from support.scenes.raster_scenes import similarity
from support.scenes.ray_rig import RayRig

SCHEDULES = [False, True]


def shapes() -> list[ls.Mesh]:
    """Returns a tetrahedron, two triangles, and one triangle."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [0.1, 1.0, 0.0], [0.3, 0.2, 0.9]])
    faces = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    return [ls.Mesh(corners, faces[:count]) for count in (4, 2, 1)]


def crowd(count: int, seed: int, meshes: list[ls.Mesh]) -> list[ls.MeshInstance]:
    """Returns instances of all sizes, with random rotations and positions in a box."""
    rng = np.random.default_rng(seed)
    size = np.exp(rng.uniform(-3.0, -1.0, count))
    axes, positions = rng.normal(size=(2, count, 3))
    poses = [similarity(tuple(axes[i]), float(i), size[i], tuple(positions[i])) for i in range(count)]
    return [ls.MeshInstance(meshes[i % len(meshes)], pose) for i, pose in enumerate(poses)]


def rays(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns origins in the box, and directions, some of them along the axes."""
    rng = np.random.default_rng(seed)
    along = rng.normal(size=(count, 3))
    along[::7] = np.eye(3)[rng.integers(0, 3, len(along[::7]))]
    return rng.uniform(-1.2, 1.2, (count, 3)), along / np.linalg.norm(along, axis=1, keepdims=True)


def nearest_one_by_one(scene: ls.Scene, origins: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns distance and instance of each ray's nearest triangle, by a loop over all instances in float64."""
    t, which = np.full(len(origins), np.inf), np.full(len(origins), -1)
    for number, instance in enumerate(scene.meshes):
        world = instance.mesh.positions @ instance.transform[:3, :3].T + instance.transform[:3, 3]
        for a, b, c in world[instance.mesh.indices]:
            edges = np.stack(np.broadcast_arrays(b - a, c - a, -along), axis=-1)
            with np.errstate(all="ignore"):
                solved = np.linalg.solve(edges + 1e-30 * np.eye(3), (origins - a)[..., None])[..., 0]
            hit = (solved[:, 0] >= 0) & (solved[:, 1] >= 0) & (solved[:, 0] + solved[:, 1] <= 1) & (solved[:, 2] > 0)
            nearer = hit & (solved[:, 2] < t)
            t[nearer], which[nearer] = solved[nearer, 2], number
    return t, which


@pytest.mark.parametrize("parallel", SCHEDULES)
def test_hits_on_thousands_of_mesh_instances_equal_a_loop_over_instances(parallel: bool) -> None:
    """The loop computes distances in float64."""
    scene = ls.Scene([], crowd(2000, 1, shapes()))
    origins, along = rays(400, 2)
    hits = RayRig(parallel=parallel).hits(scene, origins, along)
    t, which = nearest_one_by_one(scene, origins, along)
    same = hits.instance == which
    assert same.mean() > 0.99  # at edges, float32 may hit the neighbouring triangle
    np.testing.assert_allclose(hits.t[same], t[same], rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("parallel", SCHEDULES)
def test_top_level_tree_encloses_all_instances_and_is_refitted_if_they_move_little(parallel: bool) -> None:
    """The refitted tree contains all instances, and is rebuilt once its boxes are too loose."""
    launcher, meshes = Launcher("cpu", 1, parallel=parallel), shapes()
    bvhs = MeshBvhScene(launcher)
    builds = []
    start = crowd(300, 3, meshes)
    nudged = [replace(one, world_from_object=similarity(offset=(0.01, 0.0, 0.02)) @ one.transform) for one in start]
    for instances in (start, nudged, crowd(300, 4, meshes), start[:250]):
        bvhs.sync(ls.Scene([], instances))
        builds.append(bvhs.graph_key)
        nodes, order = (device_array(array).numpy() for array in (bvhs.data.tlas_nodes, bvhs.data.tlas_order))
        leaves = nodes["link"] < 0
        instance = order[~nodes["link"][leaves]]
        low, high = (np.stack([nodes[f"{side}_{k}"] for k in "xyz"], axis=-1)[leaves] for side in ("low", "high"))
        assert sorted(instance) == list(range(len(instances)))
        assert (low <= bvhs.boxes.low[instance]).all() and (high >= bvhs.boxes.high[instance]).all()
    assert builds[0] == builds[1] != builds[2] != builds[3], "nudged instances are refitted, others built anew"


def test_adding_a_mesh_does_not_rebuild_the_trees_of_other_meshes() -> None:
    """Trees are freed with the last of the meshes that were built together."""
    launcher, (one, two, three) = Launcher("cpu", 1), shapes()
    bvhs = MeshBvhScene(launcher)
    trees = []
    for meshes in ([one, two], [one, two, three], [two, three], [three], []):
        bvhs.sync(ls.Scene([], [ls.MeshInstance(mesh) for mesh in meshes]))
        trees.append([id(held) for held in bvhs._trees])
    assert [len(held) for held in trees] == [1, 2, 2, 1, 0]
    assert trees[0] == trees[1][:1] and trees[1] == trees[2] and trees[3] == trees[2][1:]
