"""Compares a frame with the one before: where instances and the camera were, and how far what is known of light holds.

The latter is in docs/method/realtime.md#light-that-changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.device.gi.surfaces import GONE, UNMOVED, InstanceMotion
from lumisplat.device.structs.camera import CameraData
from lumisplat.renderer.scene.assets import as_device_array, first_of
from lumisplat.renderer.scene.camera_table import camera_table
from lumisplat.runtime.buffers import Buffers, DeviceArray, assign_table
from lumisplat.runtime.struct_tables import upload_structs
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import Light
from lumisplat.scene.materials import Material, MaterialSimple
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

OUTDATED_HISTORY_WEIGHT = 1e-4
"""Share of its weight that a mean keeps when a light comes or goes: what is found next takes its place, and is until
then better than nothing. Many old cells of a tile together weigh less than one new sample."""

CHANGED_HISTORY_WEIGHT = 0.7
"""The same when lights move or change a little, in each of the frames that follow: means are over some three frames."""

CHANGED_FRAMES = 8
"""Frames for which means fade after a change."""

MOVED_HISTORY_WEIGHT = 0.8
"""Share of its weight that a mean keeps in a frame when things move that light falls on."""

MOVED_FRAMES = 16
"""Frames for which means fade after such a move."""

CHANGED_STRENGTH = 2.0
"""A light that is suddenly more than so many times as strong as before counts as another."""

SMALL = 16
"""Numbers that an array has at most whose values are compared."""

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
        self.history_weight = 1.0
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
        splats = previous_indices(scene.splats, before.splats, lambda instance: instance.gaussians, is_same_capture)
        meshes = previous_indices(scene.meshes, before.meshes, lambda instance: instance.mesh, is_same_mesh)
        self.splats = upload_structs(self._splat_rows(scene, before, splats), InstanceMotion, self._device)
        self.meshes = upload_structs(self._mesh_rows(scene, before, meshes), InstanceMotion, self._device)
        numbers = [*splats, *(None if number is None else len(before.splats) + number for number in meshes)]
        moved = moved_to(asset_transforms(scene), asset_transforms(before), numbers)
        self.moved_to = as_device_array(np.array(moved, np.int32), wp.int32, self._device)
        self.history_weight = self._changes.history_weight(scene, has_headlight, captures)
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
            write_motion(row, instance.transform, old.transform)
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
            write_motion(row, instance.transform, old.transform)
        return rows


def previous_indices(
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
            places[old] = UNMOVED if now[number] == before[old] else number
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


def write_motion(row: InstanceMotion, now: np.ndarray, before: np.ndarray) -> None:
    """Writes where an instance was, by its transforms, shape (4, 4) each."""
    row.existed = 1
    # What has not moved is where it was, to the last bit.
    from_now = np.eye(4) if np.array_equal(now, before) else before @ np.linalg.inv(now)
    row.before_from_now = wp.mat33(*from_now[:3, :3].ravel())
    row.before_from_now_offset = wp.vec3(*from_now[:3, 3])
    row.before_from_object = wp.mat33(*before[:3, :3].ravel())
    row.before_from_object_offset = wp.vec3(*before[:3, 3])


@dataclass(frozen=True, slots=True)
class LightState:
    """What the light of a scene comes from, and what reflects it.

    Arrays and materials are compared by identity: both scenes have to live.
    """

    sources: Sequence[object]
    """Which lights there are, and which meshes that shine, and how much."""
    strengths: list[npt.NDArray[np.float64]]
    """Of each light, by channel."""
    rest: Sequence[object]
    """The lights, meshes that shine and their places, and materials."""
    objects: Sequence[object]
    """What reflects light and casts shadows: which sets and meshes, and where."""


class LightChanges:
    """Compares the light of each frame with that of the frame before."""

    def __init__(self) -> None:
        self._before: LightState | None = None
        self._changed_ago, self._moved_ago = CHANGED_FRAMES, MOVED_FRAMES

    def forget(self) -> None:
        """There was no frame before."""
        self._before, self._changed_ago, self._moved_ago = None, CHANGED_FRAMES, MOVED_FRAMES

    def history_weight(self, scene: Scene, has_headlight: bool, captures: Sequence[int] = ()) -> float:
        """The share of its weight that what is known of light keeps in the frame that shows a scene.

        Next to nothing if a light came, went, or is suddenly of another strength: what was known is of another scene.
        If anything else about light changes, what is known is a little old: for so many frames, it fades. It fades more
        slowly if things move, whose shadows and reflections are but a part of the light.

        Args:
            scene: Of the frame.
            has_headlight: Whether one replaces the lights that the scene does not have.
            captures: The splat instances that are sampled as lights.
        """
        now = light_state(scene, has_headlight, captures)
        before, self._before = self._before or now, now
        is_other = has_changed_suddenly(before, now)
        has_changed = is_other or before.rest != now.rest
        self._changed_ago = 0 if has_changed else self._changed_ago + 1
        self._moved_ago = 0 if before.objects != now.objects else self._moved_ago + 1
        if is_other:
            return OUTDATED_HISTORY_WEIGHT
        if self._changed_ago < CHANGED_FRAMES:
            return CHANGED_HISTORY_WEIGHT
        return MOVED_HISTORY_WEIGHT if self._moved_ago < MOVED_FRAMES else 1.0


def light_state(scene: Scene, has_headlight: bool, captures: Sequence[int]) -> LightState:
    """The light of a scene, to be compared; arguments as for `LightChanges.history_weight`."""
    shining = [instance for instance in scene.meshes if instance.mesh.material.is_emissive]
    # A mesh that deforms is another one with as many vertices and faces.
    meshes = [(i.mesh.vertex_count, i.mesh.face_count, emission_of(i.mesh.material)) for i in shining]
    emitters = [scene.splats[number] for number in captures]
    sources = [has_headlight, *((type(light), light.enabled) for light in scene.lights), *meshes, len(emitters)]
    strengths = [strength_of(light) for light in scene.lights]
    lights = [values_of(light) for light in scene.lights]
    places = [(id(instance.mesh), instance.transform.tobytes()) for instance in shining]
    places += [(id(instance.gaussians), instance.transform.tobytes()) for instance in emitters]
    materials = [id(instance.material) for instance in scene.splats]
    rest = [lights, places, materials, [id(instance.mesh.material) for instance in scene.meshes]]
    return LightState(sources, strengths, rest, asset_transforms(scene))


def asset_transforms(scene: Scene) -> list[tuple[int, bytes]]:
    """What stands where in a scene, to be compared; splats first."""
    splats = [(id(instance.gaussians), instance.transform.tobytes()) for instance in scene.splats]
    return splats + [(id(instance.mesh), instance.transform.tobytes()) for instance in scene.meshes]


def strength_of(light: Light) -> npt.NDArray[np.float64]:
    """Of a light, by channel; shape (3,)."""
    return np.asarray(light.color, np.float64) * light.intensity


def emission_of(material: Material) -> tuple[object, ...]:
    """By what a material shines by itself, or by ambient light."""
    if isinstance(material, MaterialSimple):
        return material.emissive, material.ambient
    return material.emissive, material.double_sided


def has_changed_suddenly(before: LightState, now: LightState) -> bool:
    """Whether a light came or went, or one is more than ``CHANGED_STRENGTH`` times as strong, or weaker by as much."""
    if before.sources != now.sources:
        return True
    both = zip(before.strengths, now.strengths, strict=True)
    return any(np.any(np.maximum(a, b) > CHANGED_STRENGTH * np.minimum(a, b)) for a, b in both)


def in_order(lights: Sequence[Light]) -> list[Light]:
    """The enabled ones of some lights, in an order that is not that of their list but follows from what they are."""
    enabled = [light for light in lights if light.enabled]
    return sorted(enabled, key=lambda light: (type(light).__name__, repr(values_of(light))))


def values_of(light: Light) -> list[object]:
    """The values of a light's fields, to be compared."""
    return [comparable(getattr(light, field.name)) for field in fields(light)]


def comparable(value: object) -> object:
    """The value; of a large array its identity, of a small one its numbers."""
    if not isinstance(value, np.ndarray):
        return value
    numbers = cast(npt.NDArray[Any], value)
    return id(numbers) if numbers.size > SMALL else numbers.tobytes()
