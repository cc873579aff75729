"""Writes scene objects as tables of a scene file: lights, materials, placements and cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import MISSING, Field, fields
from typing import Any

import numpy as np

from lumisplat.constants import NEAR_PLANE, SIMILARITY_TOLERANCE
from lumisplat.io.scene_toml.materials import MATERIAL_KINDS
from lumisplat.io.scene_toml.toml_table import DEGREES, Values, key_of, plain_value
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import quaternions_from_matrices
from lumisplat.scene.animation.camera_path import CameraPath
from lumisplat.scene.animation.lights import LightPath, MaterialPath
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.lights import Light, LightEnvironment, LightRect
from lumisplat.scene.materials import Material

NAMED_PLACEMENT_KEYS = ("rotation_degrees", "look_at", "front", "upright", "ground")
"""Placement keys, such as ``look_at``, that are removed when a placement is written as position, rotation and scale."""
_ROUNDED = {"inner_angle": -1, "outer_angle": 1}
"""Rounding of spot angles to degrees: inner angle down (-1), outer angle up (1), so that inner <= outer stays true."""
_STEPS = 3
"""Number of neighbouring floats on each side of an angle in degrees that `_degrees` tries."""

_ROUNDING = 1e-9
"""Relative difference up to which two lengths, angles or coordinates of a camera count as equal."""
_VARYING = ("eye", "target", "up", "fov_y_degrees", "exposure", "aperture", "focus_distance")
"""Keys of a camera table that each keyframe of a moving camera has, besides ``time``."""


def light_table(light: Light) -> Values:
    """Returns the table of a light. The table of an environment does not contain its image."""
    table = {} if isinstance(light, LightEnvironment) else {"type": light.kind}
    return table | _values(light, without=("image",))


def light_path_table(path: LightPath) -> Values:
    """Returns the table of a light that changes with time, with its keyframes. An environment's image is left out."""
    first = path.lights[0]
    varying = {one for one in fields(first) if len({repr(getattr(light, one.name)) for light in path.lights}) > 1} - {
        one for one in fields(first) if one.name == "image"
    }
    aimed = {} if path.targets is None else dict.fromkeys(first.aim_fields)
    keyframes: list[Values] = []
    for number, (time, light) in enumerate(zip(np.asarray(path.times).tolist(), path.lights, strict=True)):
        table = {key_of(one): _written(one, getattr(light, one.name)) for one in varying if one.name not in aimed}
        if path.targets is not None:
            table["target"] = np.asarray(path.targets)[number].tolist()
            if isinstance(light, LightRect):
                table["size"] = [float(np.linalg.norm(edge)) for edge in (light.edge_u, light.edge_v)]
        keyframes.append({"time": time} | table)
    return {key: value for key, value in light_table(first).items() if key not in aimed} | {"keyframes": keyframes}


def material_path_table(path: MaterialPath, kind: type) -> Values:
    """Returns the keyframes of a material as a table of ``[materials]``; ``kind`` is the class of the material."""
    columns = {key: np.asarray(value).tolist() for key, value in path.values.items()}
    times = np.asarray(path.times).tolist()
    keyframes = [{"time": time} | {key: column[k] for key, column in columns.items()} for k, time in enumerate(times)]
    return {"type": _name(MATERIAL_KINDS, kind), "name": path.name, "keyframes": keyframes}


def material_table(material: Material) -> Values:
    """Returns the table of a material, without its textures."""
    textures = tuple(field.name for field in fields(material) if field.name.endswith(("_texture", "_wraps")))
    return {"type": _name(MATERIAL_KINDS, type(material))} | _values(material, without=textures)


def placement_table(matrix: Doubles) -> Values:
    """Returns the keys position, rotation_wxyz and scale that place an entry by a similarity, shape (4, 4)."""
    scale = _rounded(np.cbrt(np.linalg.det(matrix[:3, :3])))
    quaternion = quaternions_from_matrices(matrix[None, :3, :3] / scale)[0]
    return {
        "position": [_rounded(x) for x in matrix[:3, 3]],
        "rotation_wxyz": [_rounded(x) for x in quaternion],
        "scale": scale,
    }


def _rounded(number: float) -> float:
    """Rounds a number to twelve digits, so that files stay readable."""
    return float(f"{number:.12g}")


def is_similarity(matrix: Doubles) -> bool:
    """Returns whether a transform, shape (4, 4), is a rotation, a uniform scale and a translation."""
    linear = matrix[:3, :3]
    gram = linear.T @ linear
    size = np.trace(gram) / 3.0
    return bool(np.linalg.det(linear) > 0.0 and np.abs(gram / size - np.eye(3)).max() < SIMILARITY_TOLERANCE)


def _values(item: Light | Material, without: tuple[str, ...]) -> Values:
    """Returns the fields of a light or material that differ from their defaults, by table key, except ``without``."""
    table: Values = {}
    for field in fields(item):
        value = getattr(item, field.name)
        if field.name not in without and (field.default is MISSING or value != field.default):
            table[key_of(field)] = _written(field, value)
    return table


def _written(field: Field[Any], value: object) -> object:
    plain = plain_value(value)
    return _degrees(plain, _ROUNDED.get(field.name, 0)) if key_of(field).endswith(DEGREES) else plain


def _degrees(angle: float, rounded: int) -> float:
    """Converts an angle to degrees, 0 to 90, so that `math.radians` gives exactly the same angle back if possible.

    Args:
        angle: Radians.
        rounded: If no number of degrees gives the same angle back: 0 takes the nearest, 1 the next larger, -1 the next
            smaller angle.
    """
    near = [math.degrees(angle)]
    for end in (0.0, 90.0):
        step = math.degrees(angle)
        for _ in range(_STEPS):
            step = math.nextafter(step, end)
            near.append(step)
    back = {degrees: math.radians(degrees) for degrees in (*near, 0.0, 90.0) if 0.0 <= degrees <= 90.0}
    if rounded > 0:
        return min((degrees for degrees in back if back[degrees] >= angle), default=90.0)
    if rounded < 0:
        return max(degrees for degrees in back if back[degrees] <= angle)
    return min(back, key=lambda degrees: abs(back[degrees] - angle))


def _name(kinds: dict[str, Any], kind: type) -> str:
    return next(name for name, other in kinds.items() if other is kind)


def camera_tables(cameras: Sequence[Camera], path: CameraPath | None) -> tuple[list[dict[str, Any]], list[str]]:
    """Returns cameras as ``[[cameras]]`` tables, and a message for each camera that a scene file cannot store.

    Args:
        cameras: Static cameras. A camera that equals the first camera of ``path`` is left out.
        path: The moving camera.
    """
    tables: list[dict[str, Any]] = []
    problems: list[str] = []
    for number, camera in enumerate(cameras):
        table = _camera_table(camera)
        if table is None:
            problems.append(
                f"camera {camera.name or number} is left out: scene files store only cameras with square pixels, a "
                "centred principal point and no rolling shutter"
            )
        else:
            tables.append(table)
    if path is not None:
        moving = _path_table(path)
        if moving is None:
            problems.append("the moving camera is left out: scene files store only camera paths with targets")
        else:
            first = _camera_table(path.cameras[0], np.asarray(path.targets)[0])
            tables = [moving if _is_same(table, first) else table for table in tables]
            tables += [] if moving in tables else [moving]
    return tables, problems


def _camera_table(camera: Camera, target: Doubles | None = None) -> dict[str, Any] | None:
    """Returns a camera as a table with eye and target; None if a scene file cannot express it.

    Args:
        camera: The camera.
        target: World-space point in the image centre; None uses the point in focus.
    """
    width, height = camera.width, camera.height
    is_square = math.isclose(camera.fx, camera.fy, rel_tol=_ROUNDING)
    is_centred = np.allclose((camera.cx, camera.cy), (0.5 * width, 0.5 * height), rtol=_ROUNDING, atol=0.0)
    if not is_square or not is_centred or camera.camera_from_world_end is not None:
        return None
    _, down, forward = camera.camera_from_world[:3, :3]
    look_at_point: Doubles = camera.eye + camera.focus_distance * forward if target is None else target
    distance = float(np.linalg.norm(look_at_point - camera.eye))
    if not (look_at_point - camera.eye) @ forward > (1.0 - _ROUNDING) * distance > 0.0:
        return None
    fov_y = camera.fov_y
    if camera.model is CameraModel.ORTHOGRAPHIC:
        fov_y = 2.0 * math.atan(0.5 * height / (camera.fy * distance))
    table: dict[str, Any] = {"name": camera.name} if camera.name else {}
    table |= {"eye": camera.eye.tolist(), "target": look_at_point.tolist(), "up": (-down).tolist()}
    table |= {"fov_y_degrees": math.degrees(fov_y), "width": width, "height": height}
    rest = {
        "model": camera.model.value if camera.model is not CameraModel.PINHOLE else None,
        "near": camera.near if camera.near != NEAR_PLANE else None,
        "exposure": camera.exposure or None,
        "aperture": camera.aperture or None,
        "focus_distance": camera.focus_distance if camera.aperture else None,
        "distortion": list(camera.distortion) if camera.is_distorted else None,
    }
    return table | {key: value for key, value in rest.items() if value is not None}


def _path_table(path: CameraPath) -> dict[str, Any] | None:
    """Returns a moving camera as a table with keyframes; None if a scene file cannot express it."""
    if path.targets is None:
        return None
    keyframes: list[dict[str, Any]] = []
    fixed: dict[str, Any] = {}
    for camera, time, target in zip(path.cameras, np.asarray(path.times), np.asarray(path.targets), strict=True):
        table = _camera_table(camera, target)
        if table is None or camera.near != path.cameras[0].near:
            return None
        here = {"exposure": camera.exposure, "aperture": camera.aperture, "focus_distance": camera.focus_distance}
        keyframes.append({"time": float(time)} | {key: (table | here)[key] for key in _VARYING})
        fixed = fixed or {key: value for key, value in table.items() if key not in _VARYING}
    return fixed | {"keyframes": keyframes}


def _is_same(table: dict[str, Any], other: dict[str, Any] | None) -> bool:
    """Returns whether two camera tables show the same image; target distance, focus distance and name may differ."""
    if other is None or table.keys() - {"target", "focus_distance"} != other.keys() - {"target", "focus_distance"}:
        return False
    same = (key for key in table if key not in ("target", "focus_distance", "name", "model"))
    return table.get("model") == other.get("model") and all(
        np.allclose(table[key], other[key], rtol=_ROUNDING, atol=_ROUNDING) for key in same
    )
