"""Reads the cameras of a scene file: all cameras of a camera file, or one camera given by eye and target.

[[cameras]]
path = "transforms.json"            # or cameras.json, or a glTF scene

[[cameras]]
name = "front"
eye = [0.0, 1.0, 4.0]
target = [0.0, 0.5, 0.0]
fov_y_degrees = 45.0
distortion = [-0.1, 0.02, 0.0, 0.0, 0.0, 0.0]   # k1 k2 k3 k4 p1 p2, see Camera

[[cameras]]                         # a moving camera
name = "flight"
target = [0.0, 0.5, 0.0]

[[cameras.keyframes]]
time = 0.0
eye = [0.0, 1.0, 4.0]

[[cameras.keyframes]]
time = 2.0
eye = [3.0, 1.0, 3.0]               # missing keys are inherited from the previous keyframe
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.cameras.common import unique_names
from lumisplat.io.scene_toml.placement import DIRECTION, PLACEMENT, placement, scene_up
from lumisplat.io.scene_toml.toml_table import (
    COEFFICIENTS,
    NUMBER,
    TABLES,
    TEXT,
    VECTOR,
    WHOLE,
    TomlTable,
    Values,
    with_radians,
)
from lumisplat.scene.animation.camera_path import CameraPath
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.placing import Vector, up_vector

_EXPOSURE = NUMBER.about("Exposure of lit images, stops. Default: 0, or that of the file.")
CAMERA_FILE_KEYS = {
    "path": TEXT.about(
        "`transforms.json`, `cameras.json`, `camera_path.json`, a COLMAP folder, or a glTF or OpenUSD scene. Required."
    ),
    **PLACEMENT,
    "width": WHOLE.about("Image width, pixels; alone, it keeps the aspect ratio. Default: that of the file."),
    "height": WHOLE.about("Image height, pixels; alone, it keeps the aspect ratio. Default: that of the file."),
    "exposure": _EXPOSURE,
}
"""Allowed keys of a ``[[cameras]]`` entry that names a camera file."""
CAMERA_VIEW_KEYS = {
    "eye": VECTOR.about("Position of the camera. Required."),
    "target": VECTOR.about("Point in the middle of the image. Required."),
    "up": DIRECTION.about("Direction that is up in the image. Default: the scene's up."),
    "fov_y_degrees": NUMBER.about("Vertical field of view, degrees. Default: 45.8."),
    "width": WHOLE.about("Image width, pixels. Default: 1280."),
    "height": WHOLE.about("Image height, pixels. Default: 720."),
    "name": TEXT.about("Name of the camera and its images."),
    "model": TEXT.about('`"pinhole"` (default), `"fisheye"` or `"orthographic"`.'),
    "near": NUMBER.about(
        "View depth below which nothing is drawn, scene units. Default: 0.01, or less in small scenes."
    ),
    "exposure": _EXPOSURE,
    "aperture": NUMBER.about("Radius of the lens, scene units; 0 (default) has everything in focus."),
    "focus_distance": NUMBER.about("View depth of the plane in focus. Default: the distance of the target."),
    "distortion": COEFFICIENTS.about("Lens distortion k1 k2 k3 k4 p1 p2 of OpenCV. Default: 0."),
    "keyframes": TABLES.about("Motion of the camera: the tables `[[cameras.keyframes]]`."),
}
"""Allowed keys of a ``[[cameras]]`` entry that describes one camera by eye and target."""
CAMERA_KEYFRAME_KEYS = {
    "time": NUMBER.about("Time in the animation, seconds; times increase. Required."),
    **{
        key: CAMERA_VIEW_KEYS[key]._replace(
            help=f"{CAMERA_VIEW_KEYS[key].help.split('. ')[0].rstrip('.')}. Default: that of the keyframe before."
        )
        for key in ("eye", "target", "up", "fov_y_degrees", "exposure", "aperture", "focus_distance")
    },
}


class LoadCameras(Protocol):
    """Signature of `lumisplat.io.load_cameras`. Width and height apply to frames for which the file states no size."""

    def __call__(self, path: Path, /, *, width: int | None, height: int | None) -> list[Camera]:
        """Reads the cameras of a file; ``width`` and ``height`` in pixels are for frames without a stated size."""
        ...


def read_scene_cameras(
    document: TomlTable, load: LoadCameras, width: int | None = None, height: int | None = None
) -> list[Camera]:
    """Reads the cameras of a scene file, in order, with distinct names.

    Args:
        document: Top-level table of the scene file.
        load: Reads a camera file.
        width: Image width of camera-file frames for which neither the file nor the entry gives a size.
        height: Image height of camera-file frames for which neither the file nor the entry gives a size.

    Raises:
        FormatError: A key is unknown, a value is invalid, or a camera file cannot be read.
    """
    cameras: list[Camera] = []
    up = scene_up(document)
    for table in document.tables("cameras"):
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # values out of range are refused later
                if "path" in table.values:
                    cameras += _cameras_of_file(table, load, width, height)
                else:
                    cameras.append(_entry_camera(table, up))
        except FormatError:
            raise
        except SceneError as error:
            raise table.failed(error) from None
    return unique_names(cameras)


def _cameras_of_file(table: TomlTable, load: LoadCameras, width: int | None, height: int | None) -> list[Camera]:
    given = table.take(CAMERA_FILE_KEYS)
    file = table.file("path")
    if file.suffix.lower() == ".toml":
        raise table.error(f"path is {given['path']!r}, a scene file itself: list its cameras here instead", "path")
    entry_width, entry_height = given.get("width"), given.get("height")
    size = (width, height) if entry_width is None and entry_height is None else (entry_width, entry_height)
    loaded = [_move(camera, placement(table)) for camera in load(file, width=size[0], height=size[1])]
    exposure = {"exposure": given["exposure"]} if "exposure" in given else {}
    return [replace(camera.scaled(entry_width, entry_height), **exposure) for camera in loaded]


def read_camera_path(document: TomlTable) -> CameraPath | None:
    """Reads the first moving camera of a scene file, or returns None if all cameras are static.

    Raises:
        FormatError: A key is unknown, or a value is invalid.
    """
    for table in document.tables("cameras"):
        if "keyframes" in table.values:
            return _entry_path(table, scene_up(document))
    return None


def _entry_camera(table: TomlTable, up: Vector) -> Camera:
    """Reads the camera of an entry. A moving camera is returned as it is at its first keyframe."""
    if "keyframes" in table.values:
        return _entry_path(table, up).cameras[0]
    return _camera(table, table.take(CAMERA_VIEW_KEYS, required=("eye", "target")), up)


def _entry_path(table: TomlTable, up: Vector) -> CameraPath:
    """Reads a moving camera from an entry's keyframes. A keyframe inherits missing keys from the previous one."""
    last = table.take(CAMERA_VIEW_KEYS)
    del last["keyframes"]
    times: list[float] = []
    cameras: list[Camera] = []
    targets: list[list[float]] = []
    for entry in table.tables("keyframes"):
        given = entry.take(CAMERA_KEYFRAME_KEYS, required=("time",))
        time = given.pop("time")
        if not np.isfinite(time) or (times and time <= times[-1]):
            raise entry.wrong("time", f"seconds after {times[-1]:g}: times must increase" if times else "seconds")
        last |= given
        for key in ("eye", "target"):
            if key not in last:
                raise entry.error(f"lacks {key}, three numbers, here or in the camera above")
        times.append(time)
        cameras.append(_camera(entry, last, up))
        targets.append(last["target"])
    if not cameras:
        raise table.error("keyframes is empty: expected [[cameras.keyframes]]", "keyframes")
    return CameraPath(cameras, times, targets)


def _camera(table: TomlTable, given: Values, up: Vector) -> Camera:
    """Creates a camera by `Camera.look_at` from checked values; if these have no ``up``, the scene's up is used."""
    values: dict[str, Any] = dict(given)
    models = {model.value: model for model in CameraModel}
    name = values.get("model", "pinhole")
    if name not in models:
        raise table.wrong("model", " or ".join(models))
    values["model"] = models[name]
    try:
        values["up"] = up_vector(values["up"]) if "up" in values else up
    except SceneError as error:
        raise table.error(str(error), "up") from None
    lens = {key: values.pop(key) for key in ("exposure", "distortion") if key in values}  # no arguments of look_at
    widest, fov_y = 360.0 if values["model"] is CameraModel.FISHEYE else 180.0, values.get("fov_y_degrees", 45.0)
    if not 0.0 < fov_y < widest:
        raise table.error(
            f"fov_y_degrees is {fov_y}, expected more than 0 and less than {widest:g} degrees", "fov_y_degrees"
        )
    values = with_radians(table, values, widest)
    try:
        return replace(Camera.look_at(values.pop("eye"), values.pop("target"), **values), **lens)
    except SceneError as error:
        raise table.failed(error) from None


def _move(camera: Camera, world_from_file: npt.NDArray[np.float64]) -> Camera:
    """Applies a similarity transform to a camera; its scale also applies to near plane, aperture and focus distance."""
    scale = float(np.cbrt(np.linalg.det(world_from_file[:3, :3])))
    file_from_world = np.linalg.inv(world_from_file)
    focal = 1.0 / scale if camera.model is CameraModel.ORTHOGRAPHIC else 1.0
    poses: dict[str, npt.NDArray[np.float64]] = {}
    for name in ("camera_from_world", "camera_from_world_end"):
        pose = getattr(camera, name)
        if pose is not None:
            moved = pose @ file_from_world
            poses[name] = np.vstack([scale * moved[:3], moved[3]])
    lengths = {name: scale * getattr(camera, name) for name in ("near", "aperture", "focus_distance")}
    return replace(camera, fx=focal * camera.fx, fy=focal * camera.fy, **poses, **lengths)
