"""Cameras of a program as entries of a scene file, by eye, target and up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from lumisplat.constants import NEAR_PLANE
from lumisplat.math.arrays import Doubles
from lumisplat.scene.animation.camera_path import CameraPath
from lumisplat.scene.camera import Camera, CameraModel

_ROUNDING = 1e-9
"""Largest relative difference of what shall be equal."""
_VARYING = ("eye", "target", "up", "fov_y_degrees", "exposure", "aperture", "focus_distance")
"""What keyframes have, besides their times."""


def camera_tables(cameras: Sequence[Camera], path: CameraPath | None) -> tuple[list[dict[str, Any]], list[str]]:
    """Cameras as ``[[cameras]]``, and a line for each that a scene file cannot hold.

    Args:
        cameras: Those that stand still. One that is the first of the path is the one that moves.
        path: The one that moves.
    """
    tables: list[dict[str, Any]] = []
    problems: list[str] = []
    for number, camera in enumerate(cameras):
        table = camera_table(camera)
        if table is None:
            problems.append(
                f"camera {camera.name or number} is left out: scene files hold cameras with square pixels, the "
                "principal point in the middle and no rolling shutter"
            )
        else:
            tables.append(table)
    if path is not None:
        moving = _path_table(path)
        if moving is None:
            problems.append("the camera that moves is left out: scene files hold those that look at targets")
        else:
            first = camera_table(path.cameras[0], np.asarray(path.targets)[0])
            tables = [moving if _is_same(table, first) else table for table in tables]
            tables += [] if moving in tables else [moving]
    return tables, problems


def camera_table(camera: Camera, target: Doubles | None = None) -> dict[str, Any] | None:
    """A camera by its eye and target; None: it cannot be said so.

    Args:
        camera: The camera.
        target: What is in the middle of its image; None: the point in focus.
    """
    width, height = camera.width, camera.height
    is_square = math.isclose(camera.fx, camera.fy, rel_tol=_ROUNDING)
    is_centred = np.allclose((camera.cx, camera.cy), (0.5 * width, 0.5 * height), rtol=_ROUNDING, atol=0.0)
    if not is_square or not is_centred or camera.camera_from_world_end is not None:
        return None
    _, down, forward = camera.camera_from_world[:3, :3]
    seen: Doubles = camera.eye + camera.focus_distance * forward if target is None else target
    distance = float(np.linalg.norm(seen - camera.eye))
    if not (seen - camera.eye) @ forward > (1.0 - _ROUNDING) * distance > 0.0:
        return None
    fov_y = camera.fov_y
    if camera.model is CameraModel.ORTHOGRAPHIC:
        fov_y = 2.0 * math.atan(0.5 * height / (camera.fy * distance))
    table: dict[str, Any] = {"name": camera.name} if camera.name else {}
    table |= {"eye": camera.eye.tolist(), "target": seen.tolist(), "up": (-down).tolist()}
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
    """A camera that moves, by its keyframes; None: it cannot be said so."""
    if path.targets is None:
        return None
    keyframes: list[dict[str, Any]] = []
    fixed: dict[str, Any] = {}
    for camera, time, target in zip(path.cameras, np.asarray(path.times), np.asarray(path.targets), strict=True):
        table = camera_table(camera, target)
        if table is None or camera.near != path.cameras[0].near:
            return None
        here = {"exposure": camera.exposure, "aperture": camera.aperture, "focus_distance": camera.focus_distance}
        keyframes.append({"time": float(time)} | {key: (table | here)[key] for key in _VARYING})
        fixed = fixed or {key: value for key, value in table.items() if key not in _VARYING}
    return fixed | {"keyframes": keyframes}


def _is_same(table: dict[str, Any], other: dict[str, Any] | None) -> bool:
    """Whether two tables are of one view, whatever is in focus."""
    if other is None or table.keys() - {"target", "focus_distance"} != other.keys() - {"target", "focus_distance"}:
        return False
    same = (key for key in table if key not in ("target", "focus_distance", "name", "model"))
    return table.get("model") == other.get("model") and all(
        np.allclose(table[key], other[key], rtol=_ROUNDING, atol=_ROUNDING) for key in same
    )
