"""Host side of motion: where the instances of a scene, and the camera, were in the frame before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import warp as wp

from lumisplat.device.gi.surfaces import GONE, STANDS, InstanceMotion
from lumisplat.device.structs.camera import CameraData
from lumisplat.renderer.scene.camera_table import camera_table
from lumisplat.renderer.scene.light_changes import LightChanges, placed_assets
from lumisplat.renderer.scene.upload import as_device_array, first_of
from lumisplat.runtime.buffers import Buffers, DeviceArray, assign_table
from lumisplat.runtime.struct_tables import upload_structs
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

Instance = TypeVar("Instance", SplatInstance, MeshInstance)


class Motion:
    """Compares each frame's scene and camera with those of the frame before.

    Args:
        buffers: Holds the tables.
        device: Warp device name.
    """

    def __init__(self, buffers: Buffers, device: str) -> None:
        self._device = device
        self._scene: Scene | None = None
        self._camera: Camera | None = None
        self._positions: wp.array[wp.vec3] | None = None
        self._changes = LightChanges()
        self.known_share = 1.0
        """Share of its weight that what is known of light keeps; 1 unless light has changed."""
        self.camera = buffers.get("motion.camera", CameraData, 1)
        """That of the frame before; written by ``sync``."""
        self.splats: DeviceArray
        """One ``InstanceMotion`` a splat instance; like ``meshes`` written by ``sync``."""
        self.meshes: DeviceArray
        self.moved_to: wp.array[int]
        """One number an instance of the frame before, splats first, as ``has_left``."""

    def sync(
        self,
        scene: Scene,
        camera: Camera,
        positions: wp.array[wp.vec3],
        *,
        has_headlight: bool,
        captures: Sequence[int] = (),
    ) -> None:
        """Writes the tables of a frame, and keeps what the next one is compared with.

        Args:
            scene: Of the frame.
            camera: Of the frame.
            positions: Vertices of all its meshes on the device, which later frames leave as they are.
            has_headlight: Whether one replaces the lights that the scene does not have.
            captures: The splat instances that are sampled as lights.
        """
        before = self._scene or Scene()
        assign_table(self.camera, camera_table(self._camera or camera))
        splats = numbers_before(scene.splats, before.splats, lambda instance: instance.gaussians, is_same_capture)
        meshes = numbers_before(scene.meshes, before.meshes, lambda instance: instance.mesh, is_same_mesh)
        self.splats = upload_structs(self._splat_rows(scene, before, splats), InstanceMotion, self._device)
        self.meshes = upload_structs(self._mesh_rows(scene, before, meshes), InstanceMotion, self._device)
        numbers = [*splats, *(None if number is None else len(before.splats) + number for number in meshes)]
        places = moved_to(placed_assets(scene), placed_assets(before), numbers)
        self.moved_to = as_device_array(np.array(places, np.int32), wp.int32, self._device)
        self.known_share = self._changes.share(scene, has_headlight, captures)
        self._scene, self._camera = scene, camera
        self._positions = positions

    def forget(self) -> None:
        """No instance was anywhere before."""
        self._scene = self._camera = self._positions = None
        self._changes.forget()

    def _splat_rows(self, scene: Scene, before: Scene, numbers: list[int | None]) -> list[InstanceMotion]:
        rows: list[InstanceMotion] = []
        for instance, number in zip(scene.splats, numbers, strict=True):
            rows.append(row := InstanceMotion())
            if number is None:
                continue
            old = before.splats[number]
            place(row, instance.transform, old.transform)
            if old.gaussians is not instance.gaussians:
                row.deforms = 1
                rotations = np.ascontiguousarray(old.gaussians.rotations_wxyz[:, [1, 2, 3, 0]])
                row.means = as_device_array(old.gaussians.means, wp.vec3, self._device)
                row.rotations = as_device_array(rotations, wp.quat, self._device)
        return rows

    def _mesh_rows(self, scene: Scene, before: Scene, numbers: list[int | None]) -> list[InstanceMotion]:
        rows: list[InstanceMotion] = []
        first, first_before = first_vertices(scene), first_vertices(before)
        for instance, number in zip(scene.meshes, numbers, strict=True):
            rows.append(row := InstanceMotion())
            if number is None:
                continue
            old = before.meshes[number]
            if old.mesh is not instance.mesh:
                if first[id(instance.mesh)] != first_before[id(old.mesh)] or self._positions is None:
                    continue
                row.deforms, row.positions = 1, self._positions
            place(row, instance.transform, old.transform)
        return rows


def numbers_before(
    now: Sequence[Instance],
    before: Sequence[Instance],
    asset_of: Callable[[Instance], object],
    is_same: Callable[[Instance, Instance], bool],
) -> list[int | None]:
    """Which instance of the frame before each instance of this one was; None: it was not there.

    Instances of one asset are the same in their order; one of a new asset is the one at its place, if ``is_same``.
    """
    places: dict[int, list[int]] = {}
    for number, instance in enumerate(before):
        places.setdefault(id(asset_of(instance)), []).append(number)
    numbers = [places[key].pop(0) if places.get(key := id(asset_of(instance))) else None for instance in now]
    left = {number for unmatched in places.values() for number in unmatched}
    for number, instance in enumerate(now):
        if numbers[number] is None and number in left and is_same(instance, before[number]):
            numbers[number] = number
    return numbers


def moved_to(now: list[tuple[int, bytes]], before: list[tuple[int, bytes]], numbers: list[int | None]) -> list[int]:
    """By instance of the frame before, its number in this one, ``STANDS`` or ``GONE``.

    Args:
        now: The instances, and where they are.
        before: Those of the frame before.
        numbers: By instance of now, its number then; None: it was not there.
    """
    places = [GONE] * len(before)
    for number, old in enumerate(numbers):
        if old is not None:
            places[old] = STANDS if now[number] == before[old] else number
    return places


def is_same_capture(now: SplatInstance, before: SplatInstance) -> bool:
    """Whether one set may be the other, its Gaussians having moved."""
    return now.gaussians.count == before.gaussians.count


def is_same_mesh(now: MeshInstance, before: MeshInstance) -> bool:
    """Whether one mesh may be the other, its vertices having moved."""
    return now.mesh.vertex_count == before.mesh.vertex_count and now.mesh.face_count == before.mesh.face_count


def first_vertices(scene: Scene) -> dict[int, int]:
    """Where the vertices of each mesh of a scene begin, by its id, as the device has them."""
    counts = {id(instance.mesh): instance.mesh.vertex_count for instance in scene.meshes}
    return first_of(counts)


def place(row: InstanceMotion, now: np.ndarray, before: np.ndarray) -> None:
    """Writes where an instance was, by its transforms, shape (4, 4) each."""
    row.is_known = 1
    # What has not moved is where it was, to the last bit.
    from_now = np.eye(4) if np.array_equal(now, before) else before @ np.linalg.inv(now)
    row.before_from_now = wp.mat33(*from_now[:3, :3].ravel())
    row.before_from_now_offset = wp.vec3(*from_now[:3, 3])
    row.before_from_object = wp.mat33(*before[:3, :3].ravel())
    row.before_from_object_offset = wp.vec3(*before[:3, 3])
