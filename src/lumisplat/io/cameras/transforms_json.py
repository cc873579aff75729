"""Cameras of nerfstudio's, instant-ngp's and NeRF's `transforms.json`: poses are camera to world with OpenGL axes."""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.io.cameras.json_values import (
    Entry,
    inverse_rigid,
    is_list,
    number,
    number_array,
    quote,
    rigid_pose,
)
from lumisplat.io.cameras.names import name_from_image
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.references import named_path
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.texture import image_size
from lumisplat.scene.camera import Camera, CameraModel

_log = logging.getLogger("lumisplat")

OPENGL_FROM_OPENCV = np.diag((1.0, -1.0, -1.0, 1.0))
"""OpenGL cameras have -z forward and y up. This matrix is its own inverse."""

_IMAGE_EXTENSIONS = ("", ".png", ".jpg", ".jpeg")
"""Extensions that NeRF's synthetic scenes leave off their file names, in the order in which they are tried."""

_MODELS = {
    "OPENCV": CameraModel.PINHOLE,
    "PINHOLE": CameraModel.PINHOLE,
    "SIMPLE_PINHOLE": CameraModel.PINHOLE,
    "PERSPECTIVE": CameraModel.PINHOLE,
    "OPENCV_FISHEYE": CameraModel.FISHEYE,
    "FISHEYE": CameraModel.FISHEYE,
    "ORTHOPHOTO": CameraModel.ORTHOGRAPHIC,
}
"""Models by nerfstudio's names. Files are written with the first name of a model."""

_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Keys of the lens distortion, in the order of `Camera.distortion`."""


def transforms_camera(path: Path, shared: Entry, fallback: tuple[int, int] | None, frame: Entry) -> Camera:
    """The camera of one frame.

    Args:
        path: The file; images are next to it.
        shared: The top of the file, whose values hold for all frames.
        fallback: Width and height of a frame whose size neither the file nor an image gives.
        frame: The frame, whose values replace the shared ones.

    Raises:
        KeyError: A value is missing.
        SceneError: A value is invalid.
        FormatError: The image of the frame cannot be read.
    """
    values = {**shared, **frame}
    rows = values["transform_matrix"]
    row_count = 3 if is_list(rows) and len(rows) == 3 else 4
    pose = number_array(rows, (row_count, 4), "transform_matrix")
    world_from_camera = rigid_pose(pose) @ OPENGL_FROM_OPENCV
    width, height = _image_size(path, values, fallback)
    model = _model(values)
    angles = values if model is CameraModel.PINHOLE else {}  # other models have no agreed meaning for them
    fx = number(values, "fl_x") if "fl_x" in values or not angles else _focal(angles, "camera_angle_x", width)
    fy = number(values, "fl_y") if "fl_y" in values else _focal(angles, "camera_angle_y", height, default=fx)
    return Camera(
        width=width,  # pyright: ignore[reportArgumentType] # Camera refuses what is not a whole number
        height=height,  # pyright: ignore[reportArgumentType]
        fx=fx,
        fy=fy,
        cx=number(values, "cx") if "cx" in values else 0.5 * width,
        cy=number(values, "cy") if "cy" in values else 0.5 * height,
        camera_from_world=inverse_rigid(world_from_camera),
        name=name_from_image(values.get("file_path", "")),
        model=model,
        distortion=tuple(number(values, key) if key in values else 0.0 for key in _DISTORTION),  # pyright: ignore[reportArgumentType]
    )


def frame_image(folder: Path, values: Entry) -> Path | None:
    """The image of a frame in a folder, else in its ``images``; its extension may be left off. None: there is none."""
    stem = str(values.get("file_path", ""))
    candidates = (
        named_path(place, stem + extension) for place in (folder, folder / "images") for extension in _IMAGE_EXTENSIONS
    )
    return next((path for path in candidates if os.path.isfile(path)), None)


def write_transforms(path: PathLike, cameras: Sequence[Camera]) -> None:
    """As `lumisplat.io.save_cameras`."""
    model = _common_model(cameras)
    _refuse_lenses(cameras)
    if any(camera.exposure for camera in cameras):
        _log.warning("%s: a transforms.json cannot hold the exposure of cameras: left out", os.fspath(path))
    frames = [
        {
            "file_path": camera.name or f"frame_{k:05d}",
            "w": camera.width,
            "h": camera.height,
            "fl_x": camera.fx,
            "fl_y": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            **{key: value for key, value in zip(_DISTORTION, camera.distortion, strict=True) if value},
            "transform_matrix": (inverse_rigid(camera.camera_from_world) @ OPENGL_FROM_OPENCV).tolist(),
        }
        for k, camera in enumerate(cameras)
    ]
    name = next(name for name, known in _MODELS.items() if known is model)
    text = json.dumps({"camera_model": name, "frames": frames}, indent=1)
    with atomic_write(path) as temporary:
        Path(temporary).write_text(text + "\n", encoding="utf-8")


def _common_model(cameras: Sequence[Camera]) -> CameraModel:
    models = {camera.model for camera in cameras}
    if not models:
        raise SceneError("no cameras to save")
    if len(models) > 1:
        names = " and ".join(sorted(model.value for model in models))
        raise SceneError(f"a transforms.json holds cameras of one model, these are {names}: save them apart")
    return models.pop()


def _refuse_lenses(cameras: Sequence[Camera]) -> None:
    for k, camera in enumerate(cameras):
        if camera.aperture > 0.0 or camera.camera_from_world_end is not None:
            what = "an aperture" if camera.aperture > 0.0 else "a rolling shutter"
            raise SceneError(f"camera {k} ({camera.name}) has {what}, which a transforms.json cannot hold")


def _model(values: Entry) -> CameraModel:
    """The camera model of a frame.

    Raises:
        SceneError: The file names another model.
    """
    key = "camera_model" if "camera_model" in values else "camera_type"
    name = "OPENCV_FISHEYE" if values.get("is_fisheye") else values.get(key, "OPENCV")
    if not isinstance(name, str) or name.upper() not in _MODELS:
        raise SceneError(f"has {key} {quote(name)}, expected one of {', '.join(_MODELS)}")
    return _MODELS[name.upper()]


def _image_size(path: Path, values: Entry, fallback: tuple[int, int] | None) -> tuple[float, float]:
    """Width and height from the file, else from the header of the frame's image, else the fallback."""
    if "w" in values and "h" in values:
        return number(values, "w"), number(values, "h")
    image = frame_image(path.parent, values)
    if image is not None:
        return image_size(image)
    if fallback is not None:
        return fallback
    raise SceneError(
        f"has no w and h, and there is no image {str(values.get('file_path', ''))!r} to take them from: "
        "add them, or give --width and --height (width=, height=)"
    )


def _focal(values: Entry, angle_name: str, size: float, default: float | None = None) -> float:
    """Focal length in pixels for a field of view in radians."""
    if angle_name not in values:
        if default is None:
            raise SceneError("has no intrinsics: expected fl_x, or camera_angle_x")
        return default
    angle = number(values, angle_name)
    if not 0.0 < angle < math.pi:
        raise SceneError(f"has {angle_name} {angle}, expected radians between 0 and pi")
    return 0.5 * size / math.tan(0.5 * angle)
