"""Lights, environments and materials that change with time, by keyframes or by a function of time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import field, fields, replace
from functools import reduce
from typing import Any, cast, get_args

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.config.setting import frozen, given
from lumisplat.errors import LumisplatError, SceneError, check_shapes
from lumisplat.math.arrays import Doubles, finite_array, unit_vector
from lumisplat.math.transforms import axis_rotation, matrices_from_quaternions, quaternions_from_matrices, slerp
from lumisplat.scene.animation.keyframes import bracket, check_time, checked_times
from lumisplat.scene.checks import check_kind, items_of, take_scene_fields, with_checked
from lumisplat.scene.lights import Light, LightRect, PlacedLight
from lumisplat.scene.materials import Material
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene

_EDGES = ("edge_u", "edge_v")


def _lights(items: Iterable[Light], name: str = "lights") -> tuple[Light, ...]:
    """Converts a list of lights to a tuple; raises a `SceneError` if an entry is no light."""
    lights = tuple(items_of(name, items))
    for light in lights:
        if not isinstance(light, get_args(Light)):
            raise SceneError(f"{name} holds a {type(light).__name__}, expected lights")
    return cast("tuple[Light, ...]", lights)


@frozen
class LightPath:
    """A light that changes with time: K lights of one type at K times, interpolated in between.

    Positions, colours (in linear light), intensities, sizes and angles are linear in time; directions, rotations and
    the axes of rectangles turn at constant speed along the shorter arc. Before the first time and after the last one
    the light is constant.

    Raises:
        SceneError: There is no light, lights differ in type, name, image or a flag, one number is infinite in some
            lights only, shapes do not match, or times do not increase.
    """

    lights: tuple[Light, ...] = given(converter=_lights)
    times: npt.ArrayLike | None = None
    """Times of the lights in seconds, increasing, shape (K,); None: 0, 1, 2 and so on."""
    targets: npt.ArrayLike | None = None
    """World positions at which a spot, disk or rectangle aims at ``times``, shape (K, 3), linear in between; None: its
    direction is interpolated."""

    def __post_init__(self) -> None:
        take_scene_fields(self)
        if not self.lights:
            raise SceneError("a light path without lights, expected at least one")
        times = np.arange(float(len(self.lights))) if self.times is None else self.times
        object.__setattr__(self, "times", checked_times(times, len(self.lights)))
        first = self.lights[0]
        for number, light in enumerate(self.lights):
            _check_blendable(first, light, number)
        if self.targets is not None:
            targets = finite_array("targets", self.targets, np.float64)
            check_shapes(lights=(np.empty(len(self.lights)), "K"), targets=(targets, "K 3"))
            if "target" not in first.aim_keys or not isinstance(first, PlacedLight):
                raise SceneError(f"targets are given for {first.kind} lights, expected spots, disks or rectangles")
            object.__setattr__(self, "targets", targets)

    @property
    def duration(self) -> float:
        """Time of the last light, seconds."""
        return float(np.asarray(self.times)[-1])

    def at(self, time: float) -> Light:
        """Returns the light at a time in seconds.

        Raises:
            SceneError: ``time`` is not a finite number, or the light is at its target.
        """
        before, after, share = bracket(np.asarray(self.times), time)
        first, second = self.lights[before], self.lights[after]
        is_still = share == 0.0 or first is second
        if is_still and self.targets is None:
            return first
        changes: dict[str, Any] = (
            {}
            if is_still
            else {
                one.name: _blended(one.name, getattr(first, one.name), getattr(second, one.name), share)
                for one in fields(first)
                if one.name not in _EDGES and not _is_same(getattr(first, one.name), getattr(second, one.name))
            }
        )
        if isinstance(first, LightRect) and isinstance(second, LightRect) and not is_still:
            changes |= zip(_EDGES, _blended_edges(first, second, share), strict=True)
        if self.targets is not None:
            changes |= self._aimed(first, changes, before, after, share)
        return replace(first, **changes)

    def _aimed(self, first: Light, changes: Mapping[str, Any], before: int, after: int, share: float) -> dict[str, Any]:
        """Returns changed fields that aim the light at its target, in place of its interpolated direction or edges."""
        targets = np.asarray(self.targets)
        aim: dict[str, Any] = dict.fromkeys(first.aim_fields, (0.0, 0.0, 0.0))
        aim["target"] = (1.0 - share) * targets[before] + share * targets[after]
        if isinstance(first, LightRect):
            aim["size"] = [float(np.linalg.norm(changes.get(edge, getattr(first, edge)))) for edge in _EDGES]
        return aim


MovingLight = LightPath | Callable[[float], Light]
"""A light that changes with time: a path, or a function that returns the light at a time in seconds."""


def moving_lights(items: Iterable[MovingLight], name: str = "lights") -> tuple[MovingLight, ...]:
    """Converts a list of moving lights to a tuple.

    Raises:
        SceneError: An entry is neither a `LightPath` nor a function.
    """
    taken = tuple(items_of(name, items))
    for item in taken:
        if not isinstance(item, LightPath) and not callable(item):
            raise SceneError(
                f"{name} holds a {type(item).__name__}, expected LightPaths or functions of time; put lights that do "
                "not change into the scene"
            )
    return cast("tuple[MovingLight, ...]", taken)


def light_at(moving: MovingLight, time: float) -> Light:
    """Returns a moving light at a time in seconds.

    Raises:
        SceneError: The time is not finite, or the function returns no light.
    """
    check_time(time)
    if isinstance(moving, LightPath):
        return moving.at(time)
    light = moving(time)
    if not isinstance(light, get_args(Light)):
        raise SceneError(f"the function of a moving light returned a {type(light).__name__} at {time:g} s")
    return light


@frozen
class MaterialPath:
    """Changes the materials of one name with time: K values of each field at K times, linear in between.

    Colours are linear Rec.709. Before the first time and after the last one the values are constant.

    Raises:
        SceneError: There is no key, a value is not finite, shapes do not match, or times do not increase.
    """

    name: str
    """Name of the materials: all captures and meshes of the scene whose material has this name change."""
    times: npt.ArrayLike
    """Times in seconds, increasing, shape (K,)."""
    values: Mapping[str, npt.ArrayLike] = field(default_factory=dict[str, Any])
    """Values at these times by field of the material, such as ``roughness``: numbers, shape (K,), or colours (K, 3)."""

    def __post_init__(self) -> None:
        take_scene_fields(self)
        check_kind("values", self.values, Mapping, "a mapping from fields to values")
        values = {key: finite_array(key, value, np.float64) for key, value in self.values.items()}
        times = checked_times(self.times, len(np.atleast_1d(next(iter(values.values()), np.zeros(0)))))
        for key, value in values.items():
            if value.shape not in ((times.size,), (times.size, 3)):
                raise SceneError(f"{key} has shape {value.shape}, expected a list of {times.size} numbers or colours")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", values)

    @property
    def duration(self) -> float:
        """Time of the last value, seconds."""
        return float(np.asarray(self.times)[-1])

    def apply(self, material: Material, time: float) -> Material:
        """Returns a material with the values of a time in seconds.

        Raises:
            SceneError: The time is not finite, or the material has no such field, or refuses the value.
        """
        before, after, share = bracket(np.asarray(self.times), time)
        changes: dict[str, Any] = {}
        for key, value in self.values.items():
            if key not in {one.name for one in fields(material)}:
                raise SceneError(f"material {self.name!r} is a {type(material).__name__}, which has no {key}")
            blended = np.asarray(value)[before] * (1.0 - share) + np.asarray(value)[after] * share
            changes[key] = blended.tolist()
        try:
            return replace(material, **changes)
        except LumisplatError as error:
            raise SceneError(f"material {self.name!r} at {time:g} s: {error}") from None


def with_materials(scene: Scene, paths: Sequence[MaterialPath], time: float) -> Scene:
    """Returns the scene with the materials that ``paths`` change, at a time in seconds.

    Raises:
        SceneError: The time is not finite, or a material refuses a value.
    """
    if not paths:
        return scene
    changed: dict[int, Mesh] = {}

    def material_at(material: Material) -> Material:
        named = (path for path in paths if path.name == material.name)
        return reduce(lambda current, path: path.apply(current, time), named, material)

    def mesh_at(mesh: Mesh) -> Mesh:
        if id(mesh) not in changed:
            material = material_at(mesh.material)
            changed[id(mesh)] = mesh if material is mesh.material else with_checked(mesh, material=material)
        return changed[id(mesh)]

    splats = [
        one if one.material is None else _changed(one, material=material_at(one.material)) for one in scene.splats
    ]
    return _changed(
        scene, splats=tuple(splats), meshes=tuple(_changed(one, mesh=mesh_at(one.mesh)) for one in scene.meshes)
    )


def _changed(item: Any, **values: object) -> Any:
    """Returns a dataclass object with other values; the same object if all values are the same objects."""
    if all(_is_same(getattr(item, name), value) for name, value in values.items()):
        return item
    return with_checked(item, **values)


def _is_same(first: object, second: object) -> bool:
    """Returns whether two values of a field are the same object or equal plain values."""
    if first is second:
        return True
    if isinstance(first, tuple) and isinstance(second, tuple):
        pair = cast("tuple[tuple[object, ...], tuple[object, ...]]", (first, second))
        return len(pair[0]) == len(pair[1]) and all(map(_is_same, *pair))
    return isinstance(first, float | int | str) and first == second


def _check_blendable(first: Light, light: Light, number: int) -> None:
    """Raises a `SceneError` unless ``light``, entry ``number`` of a path, differs from the first in numbers alone."""
    if type(light) is not type(first):
        raise SceneError(f"light {number} of the path is a {light.kind} light, but the first is a {first.kind} light")
    for one in fields(light):
        start, here = getattr(first, one.name), getattr(light, one.name)
        if not (_is_finite(start) and _is_finite(here)) and not _is_same(start, here):
            raise SceneError(
                f"the lights of a path differ in {one.name} (light {number}), which cannot change with time"
            )


def _is_finite(value: object) -> bool:
    """Returns whether a field's value is a finite number, or a tuple of numbers, which are always finite."""
    return isinstance(value, tuple) or (is_number(value) and bool(np.isfinite(value)))


def _blended(name: str, first: Any, second: Any, share: float) -> Any:
    """Interpolates a field's value: directions and rotations turn, everything else is linear."""
    a, b = np.array(first, np.float64), np.array(second, np.float64)
    if name == "rotation_wxyz":
        return tuple(slerp(a, b, share).tolist())
    if name == "direction":
        return tuple(_turned(a, b, share).tolist())
    blended = (1.0 - share) * a + share * b
    return tuple(blended.tolist()) if blended.ndim else float(blended)


def _turned(first: Doubles, second: Doubles, share: float) -> Doubles:
    """Turns a unit vector, shape (3,), by ``share`` of the angle to another; opposite ones turn about any normal."""
    axis = np.cross(first, second)
    angle = float(np.arctan2(np.linalg.norm(axis), first @ second))
    if not np.linalg.norm(axis) > 1e-12:
        axis = np.cross(first, np.eye(3)[int(np.abs(first).argmin())])
    return np.asarray(axis_rotation(unit_vector(np.asarray(axis, np.float64)), share * angle) @ first, np.float64)


def _blended_edges(first: LightRect, second: LightRect, share: float) -> list[tuple[float, ...]]:
    """Returns both edges of a rectangle between two others: its axes turn, and its edges grow along them."""
    frames: list[Doubles] = []
    inside: list[Doubles] = []
    for rect in (first, second):
        u, normal = unit_vector(np.array(rect.edge_u)), unit_vector(rect.area_vector)
        frames.append(np.stack([u, np.cross(normal, u), normal], axis=1))
        inside.append(np.array([rect.edge_u, rect.edge_v]) @ frames[-1])
    start, end = quaternions_from_matrices(np.array(frames)).astype(np.float64)
    turned = matrices_from_quaternions(slerp(start, end, share)[None])[0]
    edges = ((1.0 - share) * inside[0] + share * inside[1]) @ turned.T
    return [tuple(edge) for edge in edges.tolist()]
