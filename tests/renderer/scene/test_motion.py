"""Previous positions of a frame's surfaces, compared with float64 transforms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.scene.motion import MOVED_BOXES
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from support.probes.probe_motion_kernels import probe_meshes, probe_pixels, probe_splats
from support.scenes.raster_scenes import front_camera, octahedron, random_gaussians, similarity

Doubles = npt.NDArray[np.float64]

CONFIG = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME)
LIGHT = ls.LightPoint((0.0, 0.0, 0.0))
HERE = similarity((1.0, 2.0, 0.5), 1.1, 0.9, (-0.8, 0.1, 4.0))
MOVES = {
    "moved": similarity(offset=(0.3, -0.2, 0.1)) @ HERE,
    "turned": similarity((0.3, 1.0, 0.2), 0.7) @ HERE,
    "scaled": HERE @ similarity(scale=1.7),
    "all three": similarity((0.0, 1.0, 0.0), 2.5, 1.4, (0.9, -0.2, 4.6)),
}
SHARES = np.array([[0.2, 0.3], [0.0, 0.0], [1.0, 0.0], [0.4, 0.6]])
"""Barycentric weights of the second and third corners."""


class Sequence:
    """Scene on the device, frame after frame."""

    def __init__(self) -> None:
        self.scene = DeviceScene(Launcher("cpu", threads=1), Buffers("cpu"), CONFIG)
        self._meshes: list[ls.MeshInstance] = []

    def show(self, *instances: ls.SplatInstance | ls.MeshInstance, camera: ls.Camera | None = None) -> None:
        """Uploads the next frame of the scene."""
        splats = [instance for instance in instances if isinstance(instance, ls.SplatInstance)]
        self._meshes = [instance for instance in instances if isinstance(instance, ls.MeshInstance)]
        scene = ls.Scene(splats, self._meshes, [LIGHT])
        self.scene.sync(scene, camera or front_camera(), FramePlan.of(CONFIG, scene))

    def splats_before(self, number: int, points: Doubles, gaussian: int = 0) -> Doubles:
        """Returns the previous positions of points that move with a Gaussian of a splat instance."""
        scene, points_in, out = self.scene, vectors(points), vectors(np.zeros_like(points))
        tables = scene.splat_instances, scene.gaussians, scene.motion.splats, out
        wp.launch(probe_splats, len(points), [number, gaussian, points_in, *tables], device="cpu")
        return out.numpy().astype(np.float64)

    def mesh_before(self, number: int, face: int, shares: Doubles = SHARES) -> Doubles:
        """Returns the previous positions of points of a mesh instance, by their weights in a triangle."""
        instance = self._meshes[number]
        points = points_of(instance, face, shares)
        distinct = {id(other.mesh): other.mesh for other in self._meshes}
        counts = [mesh.face_count for mesh in distinct.values()]
        first = sum(counts[: list(distinct).index(id(instance.mesh))])
        weights = wp.array(shares.astype(np.float32), dtype=wp.vec2, device="cpu")
        out = vectors(np.zeros_like(points))
        tables = vectors(points), weights, self.scene.mesh_data, self.scene.motion.meshes, out
        wp.launch(probe_meshes, len(points), [number, first + face, *tables], device="cpu")
        return out.numpy().astype(np.float64)


def vectors(values: Doubles) -> wp.array[wp.vec3]:
    """Returns a vec3 array on the device."""
    return wp.array(values.astype(np.float32), dtype=wp.vec3, device="cpu")


def moved(transform: Doubles, points: Doubles) -> Doubles:
    """Returns the points transformed by a matrix, shape (4, 4)."""
    return points @ transform[:3, :3].T + transform[:3, 3]


def points_of(instance: ls.MeshInstance, face: int, shares: Doubles = SHARES) -> Doubles:
    """Returns points of a triangle in world space."""
    corners = np.asarray(instance.mesh.positions, np.float64)[instance.mesh.indices[face]]
    local = (1.0 - shares.sum(axis=1, keepdims=True)) * corners[0] + shares @ corners[1:]
    return moved(instance.transform, local)


def close(found: Doubles, truth: Doubles) -> None:
    """Asserts equality within float32 precision at some units from the origin."""
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=4e-6)


def capture(seed: int = 0, count: int = 20) -> ls.Gaussians:
    """Returns Gaussians around the origin."""
    return random_gaussians(seed, count=count, center=(0.0, 0.0, 0.0), extent=(0.5, 0.5, 0.5))


def points_near(transform: Doubles, count: int = 16) -> Doubles:
    """Returns random points around an instance in world space."""
    return moved(transform, np.random.default_rng(5).uniform(-0.5, 0.5, (count, 3)))


@pytest.mark.parametrize("move", MOVES)
def test_previous_position_of_a_point_follows_from_its_instances_previous_transform(move: str) -> None:
    """The previous transform gives the previous position; one frame later, the instance has not moved."""
    gaussians, mesh, now = capture(), octahedron((0.1, 0.0, 0.0), 0.5), MOVES[move]
    sequence = Sequence()
    sequence.show(ls.SplatInstance(gaussians, HERE), ls.MeshInstance(mesh, HERE))
    sequence.show(ls.SplatInstance(gaussians, now), ls.MeshInstance(mesh, now))
    points = points_near(now)
    truth = moved(HERE @ np.linalg.inv(now), points)
    assert np.abs(truth - points).max() > 0.1
    close(sequence.splats_before(0, points), truth)
    close(sequence.mesh_before(0, 3), points_of(ls.MeshInstance(mesh, HERE), 3))
    sequence.show(ls.SplatInstance(gaussians, now), ls.MeshInstance(mesh, now))
    close(sequence.splats_before(0, points), points)


def test_previous_positions_of_points_on_still_instances_equal_the_present_to_the_bit() -> None:
    """For every transform the bits are equal, so that history is not resampled."""
    gaussians, mesh = capture(), octahedron((0.1, 0.0, 0.0), 0.5)
    sequence = Sequence()
    for _ in range(2):
        # The transforms are equal values in new arrays.
        sequence.show(ls.SplatInstance(gaussians, HERE.copy()), ls.MeshInstance(mesh, HERE.copy()))
    points = points_near(HERE).astype(np.float32).astype(np.float64)
    np.testing.assert_array_equal(sequence.splats_before(0, points), points)
    shown = points_of(ls.MeshInstance(mesh, HERE), 2).astype(np.float32)
    np.testing.assert_array_equal(sequence.mesh_before(0, 2), shown)


def test_previous_positions_of_points_on_deforming_gaussians_rotate_and_move_with_them() -> None:
    """A point keeps its position in the Gaussian's frame while Gaussian and instance move and rotate."""
    before, now = capture(1), MOVES["all three"]
    rng = np.random.default_rng(3)
    after = replace(before, means=before.means + rng.normal(0.0, 0.2, (20, 3)), rotations_wxyz=rng.normal(size=(20, 4)))
    sequence = Sequence()
    sequence.show(ls.SplatInstance(before, HERE))
    sequence.show(ls.SplatInstance(after, now))
    local = rng.normal(0.0, 0.1, (16, 3))
    for gaussian in (0, 7, 19):
        points = moved(now @ of_gaussian(after, gaussian), local)
        truth = moved(HERE @ of_gaussian(before, gaussian), local)
        close(sequence.splats_before(0, points, gaussian), truth)


def of_gaussian(gaussians: ls.Gaussians, i: int) -> Doubles:
    """Returns the transform from a Gaussian's frame to object space, shape (4, 4)."""
    w, x, y, z = np.asarray(gaussians.rotations_wxyz[i], np.float64) / np.linalg.norm(gaussians.rotations_wxyz[i])
    angle = 2.0 * np.arctan2(np.linalg.norm([x, y, z]), w)
    return similarity((x, y, z), angle, offset=tuple(gaussians.means[i]))


def bent(mesh: ls.Mesh, seed: int = 4) -> ls.Mesh:
    """Returns the mesh with randomly moved vertices."""
    rng = np.random.default_rng(seed)
    return replace(mesh, positions=mesh.positions + rng.normal(0.0, 0.1, mesh.positions.shape))


def test_previous_positions_of_points_on_deforming_meshes_keep_barycentric_weights() -> None:
    """Other meshes of the scene are unchanged."""
    still, mesh = octahedron((0.0, 0.3, 0.0), 0.4), octahedron((0.1, 0.0, 0.0), 0.5)
    now = MOVES["all three"]
    sequence = Sequence()
    sequence.show(ls.MeshInstance(still), ls.MeshInstance(mesh, HERE))
    sequence.show(ls.MeshInstance(still), ls.MeshInstance(bent(mesh), now))
    for face in (0, 5):
        close(sequence.mesh_before(1, face), points_of(ls.MeshInstance(mesh, HERE), face))
        close(sequence.mesh_before(0, face), points_of(ls.MeshInstance(still), face))


def test_mesh_without_a_matching_previous_mesh_has_no_previous_positions() -> None:
    """The law holds even if all meshes have equal numbers of vertices."""
    mesh, other, last = (octahedron((x, 0.0, 0.0), 0.4) for x in (0.0, 0.5, 1.0))
    both = bent(other)
    sequence = Sequence()
    sequence.show(*map(ls.MeshInstance, (mesh, mesh, other, last)))
    sequence.show(*map(ls.MeshInstance, (mesh, bent(mesh), both, both)))
    for number, old in enumerate((mesh, mesh, other, last)):
        found = sequence.mesh_before(number, 1)
        assert np.isnan(found).all() or np.abs(found - points_of(ls.MeshInstance(old), 1)).max() < 4e-6
    assert not np.isnan(sequence.mesh_before(0, 1)).any()


def test_new_and_replaced_instances_have_no_previous_positions() -> None:
    """In the first frame of a sequence, no instance has previous positions."""
    gaussians, mesh = capture(), octahedron((0.1, 0.0, 0.0), 0.5)
    old = ls.SplatInstance(gaussians, HERE), ls.MeshInstance(mesh, HERE)
    points = points_near(HERE)
    sequence = Sequence()
    sequence.show(*old)
    assert np.isnan(sequence.splats_before(0, points)).all() and np.isnan(sequence.mesh_before(0, 0)).all()
    sequence.show(*old, ls.SplatInstance(gaussians), ls.MeshInstance(mesh))
    close(sequence.splats_before(0, points), points)
    assert np.isnan(sequence.splats_before(1, points)).all() and np.isnan(sequence.mesh_before(1, 0)).all()
    # Instances get assets of another size.
    rest = ls.Mesh(mesh.positions, mesh.indices[:-1])
    sequence.show(ls.SplatInstance(capture(2, 21), HERE), ls.MeshInstance(rest, HERE))
    assert np.isnan(sequence.splats_before(0, points)).all() and np.isnan(sequence.mesh_before(0, 0)).all()
    sequence.scene.motion.forget()
    sequence.show(ls.SplatInstance(capture(2, 21), HERE))
    assert np.isnan(sequence.splats_before(0, points)).all()


def test_instances_of_one_asset_are_matched_in_order_between_frames() -> None:
    """Two instances that swap positions count as moved; removing an earlier instance changes nothing."""
    gaussians, mesh, moved_transform = capture(), octahedron((0.1, 0.0, 0.0), 0.5), MOVES["all three"]
    sequence = Sequence()
    sequence.show(ls.SplatInstance(gaussians, HERE), ls.SplatInstance(gaussians, moved_transform))
    sequence.show(ls.SplatInstance(gaussians, moved_transform), ls.SplatInstance(gaussians, HERE))
    points = points_near(HERE)
    close(sequence.splats_before(1, points), moved(moved_transform @ np.linalg.inv(HERE), points))
    first, second = ls.SplatInstance(capture(8)), ls.MeshInstance(octahedron((0.0, 0.0, 0.0), 0.3))
    sequence.show(first, second, ls.SplatInstance(gaussians, HERE), ls.MeshInstance(mesh, HERE))
    sequence.show(ls.SplatInstance(gaussians, moved_transform), ls.MeshInstance(mesh, moved_transform))
    points = points_near(moved_transform)
    close(sequence.splats_before(0, points), moved(HERE @ np.linalg.inv(moved_transform), points))
    close(sequence.mesh_before(0, 3), points_of(ls.MeshInstance(mesh, HERE), 3))


def test_previous_pixel_of_a_point_is_its_projection_by_the_previous_camera() -> None:
    """Pixel and distance equal the previous camera's projection; points behind that camera have no previous pixel."""
    before = ls.Camera.look_at(
        (0.3, -0.2, 0.1), (0.1, 0.2, 4.0), (0.1, -1.0, 0.0), width=70, height=50, fov_y=0.9, near=0.02
    )
    now = ls.Camera.look_at(
        (0.5, 0.2, 0.0), (0.0, 0.0, 4.0), (0.0, -1.0, 0.0), width=70, height=50, fov_y=0.9, near=0.02
    )
    sequence = Sequence()
    sequence.show(ls.SplatInstance(capture()), camera=before)
    sequence.show(ls.SplatInstance(capture()), camera=now)
    points = np.random.default_rng(7).uniform((-1.0, -1.0, -3.0), (1.0, 1.0, 5.0), (200, 3))
    out = vectors(np.zeros_like(points))
    wp.launch(probe_pixels, len(points), [vectors(points), sequence.scene.motion.camera, out], device="cpu")
    found, pose = out.numpy().astype(np.float64), before.camera_from_world
    seen = moved(pose, points)
    ahead = seen[:, 2] > before.near
    assert 20 < ahead.sum() < 180
    truth = seen[:, :2] / seen[:, 2:] * (before.fx, before.fy) + (before.cx, before.cy)
    near = ahead & (seen[:, 2] > 0.2)
    np.testing.assert_allclose(found[near, :2], truth[near], rtol=2e-6, atol=2e-4)
    np.testing.assert_allclose(found[ahead, 2], np.linalg.norm(seen[ahead], axis=1), rtol=1e-6)
    assert not found[~ahead].any()


def moved_boxes(sequence: Sequence) -> tuple[Doubles, Doubles]:
    """Returns lower and upper corners of the boxes around what has moved in the last frame."""
    motion = sequence.scene.motion
    motion.begin_frame(1)
    boxes: Any = motion.moved_boxes.numpy()
    count = int(np.asarray(motion.sequence.numpy()["moved"])[0])
    center, half = (np.asarray(boxes[name][:count], np.float64) for name in ("center", "half"))
    return center - half, center + half


def corners_of(*instances: ls.SplatInstance | ls.MeshInstance) -> tuple[Doubles, Doubles]:
    """Returns the corners of a box around vertices and means."""
    boxes = [instance.bounds() for instance in instances]
    return np.min([low for low, _ in boxes], axis=0), np.max([high for _, high in boxes], axis=0)


def test_boxes_enclose_where_moved_objects_were_and_are() -> None:
    """What stands has no box, what moves a little or deforms one, and what moves far two."""
    mesh, gaussians = octahedron((0.1, 0.0, 0.0), 0.5), capture()
    still, near = ls.MeshInstance(mesh, HERE), similarity(offset=(0.02, 0.0, 0.0)) @ HERE
    far = [similarity(offset=(x, 5.0, 0.0)) for x in (10.0, 20.0)]
    before = ls.SplatInstance(gaussians, HERE), ls.MeshInstance(mesh, far[0])
    sequence = Sequence()
    sequence.show(still, *before)
    assert len(moved_boxes(sequence)[0]) == 0
    sequence.show(still, *(after := (ls.SplatInstance(gaussians, near), ls.MeshInstance(mesh, far[1]))))
    low, high = moved_boxes(sequence)
    assert len(low) == 3
    for row, (a, b) in enumerate([corners_of(before[0], after[0]), corners_of(after[1]), corners_of(before[1])]):
        reach = 3.0 * gaussians.scales.max() if row == 0 else 0.0
        assert (low[row] <= a + 1e-6).all()
        assert (high[row] >= b - 1e-6).all()
        assert (high[row] - low[row] < 2.0 * (b - a) + 2.0 * reach).all()
    sequence.show(still, ls.SplatInstance(capture(), near), after[1])
    assert len(moved_boxes(sequence)[0]) == 1
    sequence.show(still)
    assert len(moved_boxes(sequence)[0]) == 2


def test_the_last_box_encloses_all_further_moved_objects() -> None:
    """Of 40 objects in a row, 15 have boxes of their own."""
    mesh = octahedron((0.0, 0.0, 0.0), 0.3)
    sequence = Sequence()
    sequence.show(ls.MeshInstance(mesh, HERE))
    sequence.show(
        ls.MeshInstance(mesh, HERE),
        *(ls.MeshInstance(mesh, similarity(offset=(20.0 + k, 0.0, 0.0))) for k in range(40)),
    )
    low, high = moved_boxes(sequence)
    assert len(low) == MOVED_BOXES
    np.testing.assert_allclose((low[-1, 0], high[-1, 0]), (34.7, 59.3), atol=1e-5)
    np.testing.assert_allclose(high[:-1, 0] - low[:-1, 0], 0.6, atol=1e-5)
