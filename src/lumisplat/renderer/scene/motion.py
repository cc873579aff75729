"""Compares each frame with the previous one: motion of instances and camera, and how far cached lighting is valid.

How lighting changes are handled is described in docs/method/realtime.md#light-that-changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.device.gi.surfaces import (
    GONE,
    OUTDATED_HISTORY_WEIGHT,
    UNMOVED,
    InstanceMotion,
    MovedBox,
    PreviousImage,
    SequenceData,
)
from lumisplat.device.structs.camera import CameraData
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import transform_points
from lumisplat.renderer.scene.assets import AssetCache, as_device_array, first_of
from lumisplat.renderer.scene.camera_table import camera_table
from lumisplat.renderer.scene.captured_emitters import bounds_of
from lumisplat.runtime.buffers import Buffers, DeviceArray, assign_table, rows_of
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import Light
from lumisplat.scene.materials import Material, MaterialSimple
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

CHANGED_HISTORY_WEIGHT = 0.7
"""Factor on the weight of cached lighting in each of the `CHANGED_FRAMES` frames after lights move or change a little;
means then cover about three frames."""

BRIGHTENED_HISTORY_WEIGHT = 0.5
"""It replaces `CHANGED_HISTORY_WEIGHT` after the strength of a light changes: all of its light is then outdated."""

CHANGED_FRAMES = 8
"""Number of frames for which the weight of cached lighting is reduced after lights change."""

MOVED_HISTORY_WEIGHT = 0.8
"""Factor on the weight of cached lighting in each of the `MOVED_FRAMES` frames after objects move."""

MOVED_FRAMES = 16
"""Number of frames for which the weight of cached lighting is reduced after objects move."""

CHANGED_STRENGTH = 2.0
"""Ratio of a light's strengths in two consecutive frames above which the change counts as sudden, like a new light."""

COMPARED_BY_VALUE_MAX = 16
"""Largest number of elements with which two arrays are compared by value; larger ones are compared by identity."""

MOVED_BOXES = 16
"""Largest number of boxes around objects that have moved; the last one encloses all further objects."""

Instance = TypeVar("Instance", SplatInstance, MeshInstance)


class Motion:
    """Compares each frame's scene and camera with those of the previous frame.

    Args:
        buffers: Holds the tables.
        device: Warp device name.
    """

    def __init__(self, buffers: Buffers, device: str) -> None:
        self._buffers, self._device = buffers, device
        self._scene: Scene | None = None
        self._camera: Camera | None = None
        self._positions: wp.array[wp.vec3] | None = None
        self._changes = LightChanges()
        self._bounds: AssetCache[Doubles] = AssetCache(bounds_of)
        self._moved = 0
        self.history_weight = 1.0
        """Factor on the weight of cached lighting in this frame, 0..1; 1 unless lighting has changed."""
        self.sequence = buffers.get("motion.sequence", SequenceData, 1)
        """Number of the frame and `history_weight` as a table for kernels; written by ``begin_frame``."""
        self.camera = buffers.get("motion.camera", CameraData, 1)
        """Camera of the previous frame, with the lens and image size of this frame's if the size has changed; written
        by ``sync``."""
        self.image_before: PreviousImage
        """Images of the previous frame."""
        self.size_before: tuple[int, int]
        """Width and height of the previous frame's images, pixels; those of this frame if there is none."""
        self.splats: DeviceArray
        """``InstanceMotion`` of each splat instance; the field ``meshes`` has the mesh instances. Written by ``sync``.
        """
        self.meshes: DeviceArray
        self.moved_to: wp.array[int]
        """Index in this frame of each instance of the previous frame, splat instances first; UNMOVED (-1) if it stood
        still, GONE (-2) if it was removed."""
        self.moved_boxes: wp.array[MovedBox]
        """Boxes around objects that have moved; `MOVED_BOXES` rows, of which the first ``SequenceData.moved`` count."""
        self.light_before: wp.array[int]
        """Index in the previous frame of each light; -1: the light is new."""
        self.light_kept: wp.array[int]
        """1: the light stands where it stood in the previous frame; 0: it has moved, or is new."""

    def sync(
        self,
        scene: Scene,
        camera: Camera,
        positions: wp.array[wp.vec3],
        *,
        has_headlight: bool,
        captures: Sequence[int] = (),
    ) -> None:
        """Writes the motion tables of a frame, and stores its scene and camera for the next frame.

        Args:
            scene: Scene of the frame.
            camera: Camera of the frame.
            positions: Vertices of all meshes on the device; later frames must not overwrite the array.
            has_headlight: Whether a headlight replaces missing lights.
            captures: Indices of the splat instances that are sampled as lights.
        """
        before = self._scene or Scene()
        camera_before = self._camera or camera
        self.size_before, self.image_before = camera_before.image_size, previous_image(camera_before, camera)
        assign_table(self.camera, camera_table(in_size_of(camera, camera_before)))
        splats = previous_indices(scene.splats, before.splats, lambda instance: instance.gaussians, is_same_capture)
        meshes = previous_indices(scene.meshes, before.meshes, lambda instance: instance.mesh, is_same_mesh)
        self.splats = self._table("motion.splats", self._splat_rows(scene, before, splats))
        self.meshes = self._table("motion.meshes", self._mesh_rows(scene, before, meshes))
        numbers = [*splats, *(None if number is None else len(before.splats) + number for number in meshes)]
        moved = moved_to(asset_transforms(scene), asset_transforms(before), numbers)
        self.moved_to = self._buffers.upload("motion.moved_to", wp.int32, np.array(moved, np.int32))
        boxes = self._boxes_of_moved(scene, before) if self._scene else []
        self._moved = len(boxes)
        rows = boxes + [MovedBox()] * (MOVED_BOXES - len(boxes))
        self.moved_boxes = self._buffers.table("motion.moved_boxes", MovedBox, rows)
        lights = lights_before(scene.lights, before.lights)
        if has_headlight:
            lights = [-1 if before.lights else 0]
        self.light_before = self._buffers.upload("motion.light_before", wp.int32, np.array(lights, np.int32))
        kept = [has_same_place(scene.lights, before.lights, *pair) for pair in enumerate(lights)]
        self.light_kept = self._buffers.upload("motion.light_kept", wp.int32, np.array(kept, np.int32))
        self.history_weight = self._changes.history_weight(scene, has_headlight, captures)
        self._scene, self._camera = scene, camera
        self._positions = positions

    @property
    def graph_key(self) -> object:
        """Numbers of instances in this frame and the previous one; a CUDA graph recorded with others is stale."""
        return len(self.splats), len(self.meshes), len(self.moved_to)

    def begin_frame(self, number: int) -> None:
        """Writes the number of the frame in its sequence, and the weight of cached lighting, for kernels."""
        row = SequenceData()
        row.frame, row.history_weight, row.before = number, self.history_weight, self.image_before
        row.moved = self._moved
        assign_table(self.sequence, rows_of([row]))

    def forget(self) -> None:
        """Forgets the previous frame: in the next frame, nothing has moved and nothing has a history."""
        self._scene = self._camera = self._positions = None
        self._bounds.of([])
        self._changes.forget()

    def _table(self, name: str, rows: list[InstanceMotion]) -> DeviceArray:
        """Returns the motions of instances as a table, at least one row; its address stays the same.

        The table keeps alive the arrays to which its rows point.
        """
        table = self._buffers.table(name, InstanceMotion, rows or [InstanceMotion()])
        table.keep_alive = rows
        return table

    def _boxes_of_moved(self, scene: Scene, before: Scene) -> list[MovedBox]:
        """Returns boxes around objects that have moved, appeared or left: where they were, and where they are."""
        here = dict(zip(asset_transforms(scene), (*scene.splats, *scene.meshes), strict=True))
        there = dict(zip(asset_transforms(before), (*before.splats, *before.meshes), strict=True))
        changed = [one for key, one in (here | there).items() if (key in here) != (key in there)]
        splats = [one for one in changed if isinstance(one, SplatInstance) and one.gaussians.count]
        bounds = self._bounds.of([one.gaussians for one in splats])
        boxes = [world_box(one, *box) for one, box in zip(splats, bounds, strict=True)]
        boxes += [world_box(one, *one.mesh.bounds()) for one in changed if isinstance(one, MeshInstance)]
        rows: list[MovedBox] = []
        for low, high in merged(boxes):
            rows.append(row := MovedBox())
            row.center, row.half = wp.vec3(*(0.5 * (low + high))), wp.vec3(*(0.5 * (high - low)))
        return rows

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


def in_size_of(camera: Camera, before: Camera) -> Camera:
    """Returns the previous frame's camera, with the lens and image size of ``camera`` if their sizes differ."""
    if before.image_size == camera.image_size:
        return before
    return replace(camera, camera_from_world=before.camera_from_world)


def previous_image(before: Camera, now: Camera) -> PreviousImage:
    """Returns the images of the previous frame, given its camera and the one of this frame."""
    image = PreviousImage()
    image.size, image.scale = wp.vec2i(*before.image_size), wp.vec2(1.0)
    if before.image_size != now.image_size:
        x, y = before.fx / now.fx, before.fy / now.fy
        image.scale, image.shift = wp.vec2(x, y), wp.vec2(before.cx - x * now.cx, before.cy - y * now.cy)
    return image


def previous_indices(
    now: Sequence[Instance],
    before: Sequence[Instance],
    asset_of: Callable[[Instance], object],
    is_same: Callable[[Instance, Instance], bool],
) -> list[int | None]:
    """Returns the index that each instance had in the previous frame; None: the instance is new.

    Instances of one asset correspond in order. An instance of a new asset corresponds to the previous instance with the
    same index, if ``is_same`` accepts the pair.
    """
    candidates: dict[int, list[int]] = {}
    for number, instance in enumerate(before):
        candidates.setdefault(id(asset_of(instance)), []).append(number)
    numbers = [candidates[key].pop(0) if candidates.get(key := id(asset_of(instance))) else None for instance in now]
    left = {number for unmatched in candidates.values() for number in unmatched}
    for number, instance in enumerate(now):
        if numbers[number] is None and number in left and is_same(instance, before[number]):
            numbers[number] = number
    return numbers


def moved_to(now: list[tuple[int, bytes]], before: list[tuple[int, bytes]], numbers: list[int | None]) -> list[int]:
    """Returns the index in this frame of each instance of the previous frame.

    The index is ``UNMOVED`` if the instance stands still, and ``GONE`` if the instance is not in this frame.

    Args:
        now: Asset's id and transform's bytes of each instance.
        before: Asset's id and transform's bytes of each instance of the previous frame.
        numbers: Index that each instance of this frame had in the previous frame; None: the instance is new.
    """
    moved = [GONE] * len(before)
    for number, old in enumerate(numbers):
        if old is not None:
            moved[old] = UNMOVED if now[number] == before[old] else number
    return moved


def lights_before(now: Sequence[Light], before: Sequence[Light]) -> list[int]:
    """Returns the index that each light had in the previous frame; -1: the light is new.

    Lights with equal values correspond; of the others, those of one type do in order of their values.
    """
    left = list(range(len(before)))
    numbers = [-1] * len(now)
    for key in (light_values, light_look, type):
        of_before = [key(light) for light in before]
        for number, light in enumerate(now):
            if numbers[number] < 0:
                wanted = key(light)
                numbers[number] = next((other for other in left if of_before[other] == wanted), -1)
                if numbers[number] >= 0:
                    left.remove(numbers[number])
    return numbers


def has_same_place(now: Sequence[Light], before: Sequence[Light], number: int, old: int) -> bool:
    """Returns whether light ``number`` is where light ``old`` of the previous frame was; False for the headlight."""
    if not 0 <= old < len(before) or number >= len(now):
        return False
    return light_place(now[number]) == light_place(before[old])


def light_values(light: Light) -> object:
    """Returns type and values of a light, by which it is recognised when it stands still."""
    return type(light), values_of(light)


def light_place(light: Light) -> object:
    """Returns type and values of a light that decide where it is visible."""
    look = {"name", "color", "intensity", "range", "inner_angle", "outer_angle"}
    return type(light), [comparable(getattr(light, field.name)) for field in fields(light) if field.name not in look]


def light_look(light: Light) -> object:
    """Returns type, name, colour and intensity of a light, by which it is recognised when it moves."""
    return type(light), light.name, comparable(np.asarray(light.color)), light.intensity


def is_same_capture(now: SplatInstance, before: SplatInstance) -> bool:
    """Returns whether two Gaussian sets may be one capture whose Gaussians have moved: their counts are equal."""
    return now.gaussians.count == before.gaussians.count


def is_same_mesh(now: MeshInstance, before: MeshInstance) -> bool:
    """Returns whether two meshes may be one mesh whose vertices have moved: vertex and face counts are equal."""
    return now.mesh.vertex_count == before.mesh.vertex_count and now.mesh.face_count == before.mesh.face_count


def first_vertices(scene: Scene) -> dict[int, int]:
    """Returns the index of each mesh's first vertex in the device arrays, by ``id`` of the mesh."""
    counts = {id(instance.mesh): instance.mesh.vertex_count for instance in scene.meshes}
    return first_of(counts)


def write_motion(row: InstanceMotion, now: np.ndarray, before: np.ndarray) -> None:
    """Writes an instance's motion from its transforms in this and the previous frame, shape (4, 4) each."""
    row.existed = 1
    # An unmoved instance gets the exact identity.
    from_now = np.eye(4) if np.array_equal(now, before) else before @ np.linalg.inv(now)
    row.before_from_now = wp.mat33(*from_now[:3, :3].ravel())
    row.before_from_now_offset = wp.vec3(*from_now[:3, 3])
    row.before_from_object = wp.mat33(*before[:3, :3].ravel())
    row.before_from_object_offset = wp.vec3(*before[:3, 3])


@dataclass(frozen=True, slots=True)
class LightState:
    """A scene's light sources and reflecting objects, in a form that can be compared.

    Large arrays are compared by identity, so the scenes of both states must be alive.
    """

    sources: Sequence[object]
    """Type of each light, and size and emission of each emissive mesh: if they differ, a light appeared or
    disappeared."""
    lights: Sequence[Light]
    other_values: Sequence[object]
    """Everything else that determines lighting: fields of lights, transforms of emissive objects."""
    materials: Sequence[Material | None]
    """Material of each instance, splats first."""
    objects: Sequence[object]
    """Gaussian sets and meshes with their transforms and how they are shown: the objects that reflect light and cast
    shadows."""


class LightChanges:
    """Compares the lighting of each frame with that of the previous frame."""

    def __init__(self) -> None:
        self._before: LightState | None = None
        self._changed_ago, self._moved_ago = CHANGED_FRAMES, MOVED_FRAMES
        self._changed_weight = CHANGED_HISTORY_WEIGHT

    def forget(self) -> None:
        """Forgets the previous frame: in the next frame, no light has changed."""
        self._before, self._changed_ago, self._moved_ago = None, CHANGED_FRAMES, MOVED_FRAMES

    def history_weight(self, scene: Scene, has_headlight: bool, captures: Sequence[int] = ()) -> float:
        """Returns the factor on the weight of cached lighting in this frame, 0..1; 1 unless lighting has changed.

        The factor is nearly 0 if a light appears, disappears or abruptly changes its strength. After any other change
        of lights, cached lighting fades over several frames. After objects move, cached lighting fades more slowly,
        because shadows and reflections of objects are only a part of the light.

        Args:
            scene: Scene of the frame.
            has_headlight: Whether a headlight replaces missing lights.
            captures: Indices of the splat instances that are sampled as lights.
        """
        now = light_state(scene, has_headlight, captures)
        before, self._before = self._before or now, now
        ratio = strength_ratio(before, now)
        is_other = ratio > CHANGED_STRENGTH
        has_changed = (
            is_other or before.other_values != now.other_values or have_changed(before.materials, now.materials)
        )
        self._changed_ago = 0 if has_changed else self._changed_ago + 1
        if has_changed:
            self._changed_weight = BRIGHTENED_HISTORY_WEIGHT if ratio > 1.0 else CHANGED_HISTORY_WEIGHT
        self._moved_ago = 0 if before.objects != now.objects else self._moved_ago + 1
        if is_other:
            return OUTDATED_HISTORY_WEIGHT
        if self._changed_ago < CHANGED_FRAMES:
            return self._changed_weight
        return MOVED_HISTORY_WEIGHT if self._moved_ago < MOVED_FRAMES else 1.0


def light_state(scene: Scene, has_headlight: bool, captures: Sequence[int]) -> LightState:
    """Returns the light state of a scene; arguments as for `LightChanges.history_weight`."""
    shining = [instance for instance in scene.meshes if instance.mesh.material.is_emissive]
    # A deforming mesh is a new object with equal numbers of vertices and faces.
    meshes = [(i.mesh.vertex_count, i.mesh.face_count, emission_of(i.mesh.material)) for i in shining]
    emitters = [scene.splats[number] for number in captures]
    sources = [has_headlight, *((type(light), light.enabled) for light in scene.lights), *meshes, len(emitters)]
    lights = [values_of(light) for light in scene.lights]
    transforms = [(id(instance.mesh), instance.transform.tobytes()) for instance in shining]
    transforms += [(id(instance.gaussians), instance.transform.tobytes()) for instance in emitters]
    materials = [instance.material for instance in scene.splats] + [instance.mesh.material for instance in scene.meshes]
    shown = [(one.sh_degree, one.shadow_catcher, one.depth_iso_transmittance) for one in scene.splats]
    shown += [(-1, instance.shadow_catcher, None) for instance in scene.meshes]
    return LightState(sources, scene.lights, [lights, transforms], materials, [asset_transforms(scene), shown])


def world_box(
    instance: SplatInstance | MeshInstance, low: npt.ArrayLike, high: npt.ArrayLike
) -> tuple[Doubles, Doubles]:
    """Returns lower and upper corner of a box around an instance, given those of its asset in object space."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    center = transform_points(instance.transform, 0.5 * (low + high))
    half = np.abs(instance.transform[:3, :3]) @ (0.5 * (high - low))
    return center - half, center + half


def merged(boxes: list[tuple[Doubles, Doubles]]) -> list[tuple[Doubles, Doubles]]:
    """Joins each box to an earlier one that contains its centre, as of an object that has moved a little.

    Of more than `MOVED_BOXES`, the last encloses all further ones.
    """
    found: list[tuple[Doubles, Doubles]] = []
    for low, high in boxes:
        center = 0.5 * (low + high)
        near = next((k for k, (a, b) in enumerate(found) if ((a <= center) & (center <= b)).all()), None)
        if near is None and len(found) < MOVED_BOXES:
            found.append((low, high))
        else:
            k = -1 if near is None else near
            found[k] = np.minimum(found[k][0], low), np.maximum(found[k][1], high)
    return found


def asset_transforms(scene: Scene) -> list[tuple[int, bytes]]:
    """Returns the asset's id and the transform's bytes of each instance, to compare frames; splats first."""
    splats = [(id(instance.gaussians), instance.transform.tobytes()) for instance in scene.splats]
    return splats + [(id(instance.mesh), instance.transform.tobytes()) for instance in scene.meshes]


def strength_of(light: Light) -> npt.NDArray[np.float64]:
    """Returns colour times intensity of a light, by channel, shape (3,)."""
    return np.asarray(light.color, np.float64) * light.intensity


def emission_of(material: Material) -> tuple[object, ...]:
    """Returns the values of a material that determine its emission."""
    if isinstance(material, MaterialSimple):
        return material.emissive, material.ambient
    return material.emissive, material.double_sided


def strength_ratio(before: LightState, now: LightState) -> float:
    """Returns the largest ratio, by channel, of a light's strengths in two frames; inf if a light came or went."""
    if before.sources != now.sources:
        return math.inf
    if before.other_values == now.other_values:
        return 1.0
    ratio = 1.0
    for light, number in zip(now.lights, lights_before(now.lights, before.lights), strict=True):
        # Lights of a scene are sorted by position, so that lamps that move change their order.
        for pair in zip(strength_of(light), strength_of(before.lights[number]), strict=True):
            low, high = min(pair), max(pair)
            if high > 0.0:
                ratio = max(ratio, high / low if low > 0.0 else math.inf)
    return ratio


def have_changed(before: Sequence[Material | None], now: Sequence[Material | None]) -> bool:
    """Returns whether materials differ in number or in their values; equal objects are not looked into."""
    pairs = zip(before, now, strict=False)
    return len(before) != len(now) or any(a is not b and values_of(a) != values_of(b) for a, b in pairs)


def in_order(lights: Sequence[Light]) -> list[Light]:
    """Returns the enabled lights sorted by type and values, so that their order in the scene does not matter."""
    enabled = [light for light in lights if light.enabled]
    return sorted(enabled, key=lambda light: (type(light).__name__, repr(values_of(light))))


def values_of(item: Light | Material | None) -> list[object]:
    """Returns the fields of a light or material as values that can be compared with those of another frame."""
    return [comparable(getattr(item, field.name)) for field in fields(item)] if item else []


def comparable(value: object) -> object:
    """Returns a value to compare with ``==``: a large array's identity, a small array's bytes, else the value."""
    if not isinstance(value, np.ndarray):
        return value
    numbers = cast(npt.NDArray[Any], value)
    return id(numbers) if numbers.size > COMPARED_BY_VALUE_MAX else numbers.tobytes()
