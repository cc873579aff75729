"""Reads camera files in JSON, recognised by their content, and writes ``transforms.json``.

Supported are ``transforms.json`` (nerfstudio, instant-ngp, NeRF), ``camera_path.json`` (nerfstudio) and
``cameras.json`` (INRIA). The first two have camera-to-world poses with OpenGL axes. INRIA's files have OpenCV axes and
the principal point at the image centre. Poses must be rigid. Errors about one frame have texts such as "has no focal
length", which `decode_frame` puts after "frame 3".
"""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.cameras.common import name_from_image, unique_names
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike, is_list, is_object, named_path, parsing, read_text
from lumisplat.io.images.texture import image_size
from lumisplat.math.arrays import finite_numbers
from lumisplat.scene.camera import Camera, CameraModel

_log = logging.getLogger("lumisplat")

Entry = Mapping[str, Any]
"""A parsed JSON object: a whole camera file, or one of its frames."""
Matrix = npt.NDArray[np.float64]

_PATH_MODELS = {"perspective": CameraModel.PINHOLE, "fisheye": CameraModel.FISHEYE}

OPENGL_FROM_OPENCV = np.diag((1.0, -1.0, -1.0, 1.0))
"""Converts OpenCV camera axes to OpenGL camera axes, which have -z forward and y up. The matrix is its own inverse."""

_IMAGE_EXTENSIONS = ("", ".png", ".jpg", ".jpeg")
"""Extensions that are tried, in order, for a file name without extension, as in NeRF's synthetic scenes."""

_MODELS = {
    "OPENCV": CameraModel.PINHOLE,
    "PINHOLE": CameraModel.PINHOLE,
    "SIMPLE_PINHOLE": CameraModel.PINHOLE,
    "PERSPECTIVE": CameraModel.PINHOLE,
    "OPENCV_FISHEYE": CameraModel.FISHEYE,
    "FISHEYE": CameraModel.FISHEYE,
    "ORTHOPHOTO": CameraModel.ORTHOGRAPHIC,
}
"""Camera models by their names in ``transforms.json``. Files are written with the first of several names."""

_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Keys of the lens distortion, in the order of `Camera.distortion`."""


def quote(value: object) -> str:
    """Formats a value as JSON for a message, at most 40 characters."""
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _number(values: Entry, name: str) -> float:
    """Returns the number ``values[name]``; raises `SceneError` if it is not a number."""
    value = values[name]
    if not is_number(value):
        raise SceneError(f"has {name} {quote(value)}, expected a number")
    return value


def _number_array(values: object, shape: tuple[int, ...], name: str) -> Matrix:
    """Converts nested lists to an array; raises `SceneError` if a number is not finite or the shape is wrong.

    ``name`` is the key of the lists, for the message.
    """
    array = finite_numbers(values, shape)
    if array is None:
        raise SceneError(f"has {name} {quote(values)}, expected {' x '.join(map(str, shape))} finite numbers")
    return array


def _rigid_pose(matrix: Matrix) -> Matrix:
    """Checks that a pose, shape (3 or 4, 4), is rigid. Returns it without rounding errors, shape (4, 4)."""
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, (0.0, 0.0, 0.0, 1.0)])
    u, singular_values, v = np.linalg.svd(matrix[:3, :3])
    if singular_values[2] <= 1e-9 * singular_values[0]:
        raise SceneError("has a singular pose matrix")
    if np.ptp(singular_values) > 1e-3 * singular_values[0]:
        raise SceneError("has a pose that shears or stretches, expected a rotation and a translation")
    if abs(singular_values[0] - 1.0) > 1e-3:
        raise SceneError(f"has a pose scaled by {singular_values[0]:.6g}, expected a rotation and a translation")
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        raise SceneError("has a pose that mirrors, expected a rotation and a translation")
    if np.abs(singular_values - 1.0).max() > 1e-12:
        matrix[:3, :3] = u @ v
    return matrix


def _inverse_rigid(matrix: Matrix) -> Matrix:
    """Inverts a rigid transform, shape (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse


def _path_camera(shared: Entry, frame: Entry) -> Camera:
    """Creates the camera of one frame of a ``camera_path.json``.

    Args:
        shared: Top-level object of the file.
        frame: An entry of ``camera_path``.
    """
    kind: Any = shared.get("camera_type", "perspective")
    if kind not in _PATH_MODELS:
        raise SceneError(f"has camera_type {quote(kind)}, expected {' or '.join(_PATH_MODELS)}")
    values = frame["camera_to_world"]
    shape = (16,) if is_list(values) and len(values) == 16 else (4, 4)
    pose = _number_array(values, shape, "camera_to_world").reshape(4, 4)
    fov = _number(frame, "fov")
    if not 0.0 < fov < 180.0:
        raise SceneError(f"has fov {fov}, expected degrees between 0 and 180")
    width, height = _number(shared, "render_width"), _number(shared, "render_height")
    focal = 0.5 * height / math.tan(0.5 * math.radians(fov))
    return Camera(
        width=width,  # pyright: ignore[reportArgumentType] # Camera refuses what is not a whole number
        height=height,  # pyright: ignore[reportArgumentType]
        fx=focal,
        fy=focal,
        cx=0.5 * width,
        cy=0.5 * height,
        camera_from_world=_inverse_rigid(_rigid_pose(pose) @ OPENGL_FROM_OPENCV),
        model=_PATH_MODELS[kind],
    )


def _path_rate(content: Entry) -> float:
    """Returns the frames per second of a ``camera_path.json``, 24 by default."""
    fps = _number(content, "fps") if "fps" in content else 24.0
    if not 0.0 < fps < math.inf:
        raise SceneError(f"has fps {fps}, expected a positive number")
    return fps


def _inria_camera(entry: Entry) -> Camera:
    """Creates the camera of one entry of INRIA's ``cameras.json``."""
    width, height = _number(entry, "width"), _number(entry, "height")
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = _number_array(entry["rotation"], (3, 3), "rotation")
    world_from_camera[:3, 3] = _number_array(entry["position"], (3,), "position")
    return Camera(
        width=width,  # pyright: ignore[reportArgumentType] # Camera refuses what is not a whole number
        height=height,  # pyright: ignore[reportArgumentType]
        fx=_number(entry, "fx"),
        fy=_number(entry, "fy"),
        cx=0.5 * width,
        cy=0.5 * height,
        camera_from_world=_inverse_rigid(_rigid_pose(world_from_camera)),
        name=name_from_image(entry.get("img_name", "")),
    )


def transforms_camera(path: Path, shared: Entry, fallback: tuple[int, int] | None, frame: Entry) -> Camera:
    """Creates the camera of one frame of a ``transforms.json``.

    Args:
        path: The file; images are relative to its folder.
        shared: Top-level object of the file, whose values apply to all frames.
        fallback: Width and height of a frame whose size neither the file nor an image gives.
        frame: The frame, whose values override those of ``shared``.

    Raises:
        KeyError: A value is missing.
        SceneError: A value is invalid.
        FormatError: The image of the frame cannot be read.
    """
    values = {**shared, **frame}
    rows = values["transform_matrix"]
    row_count = 3 if is_list(rows) and len(rows) == 3 else 4
    pose = _number_array(rows, (row_count, 4), "transform_matrix")
    world_from_camera = _rigid_pose(pose) @ OPENGL_FROM_OPENCV
    width, height = _image_size(path, values, fallback)
    model = _model(values)
    angles = values if model is CameraModel.PINHOLE else {}  # undefined for other models
    fx = _number(values, "fl_x") if "fl_x" in values or not angles else _focal(angles, "camera_angle_x", width)
    fy = _number(values, "fl_y") if "fl_y" in values else _focal(angles, "camera_angle_y", height, default=fx)
    return Camera(
        width=width,  # pyright: ignore[reportArgumentType] # Camera refuses what is not a whole number
        height=height,  # pyright: ignore[reportArgumentType]
        fx=fx,
        fy=fy,
        cx=_number(values, "cx") if "cx" in values else 0.5 * width,
        cy=_number(values, "cy") if "cy" in values else 0.5 * height,
        camera_from_world=_inverse_rigid(world_from_camera),
        name=name_from_image(values.get("file_path", "")),
        model=model,
        distortion=tuple(_number(values, key) if key in values else 0.0 for key in _DISTORTION),  # pyright: ignore[reportArgumentType]
    )


def frame_image(folder: Path, values: Entry) -> Path | None:
    """Returns the image file that ``file_path`` of a frame names, in the folder or else its subfolder ``images``.

    ``file_path`` may lack the extension. None if there is no such file.
    """
    stem = str(values.get("file_path", ""))
    candidates = (
        named_path(directory, stem + extension)
        for directory in (folder, folder / "images")
        for extension in _IMAGE_EXTENSIONS
    )
    return next((path for path in candidates if os.path.isfile(path)), None)


def write_transforms(path: PathLike, cameras: Sequence[Camera]) -> None:
    """Writes a ``transforms.json``; see `lumisplat.io.save_cameras`."""
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
            "transform_matrix": (_inverse_rigid(camera.camera_from_world) @ OPENGL_FROM_OPENCV).tolist(),
        }
        for k, camera in enumerate(cameras)
    ]
    name = next(name for name, other in _MODELS.items() if other is model)
    text = json.dumps({"camera_model": name, "frames": frames}, indent=1)
    with atomic_write(path) as temporary:
        Path(temporary).write_text(text + "\n", encoding="utf-8")


def _common_model(cameras: Sequence[Camera]) -> CameraModel:
    models = {camera.model for camera in cameras}
    if not models:
        raise SceneError("no cameras to save")
    if len(models) > 1:
        names = " and ".join(sorted(model.value for model in models))
        raise SceneError(f"a transforms.json holds only one camera model, got {names}: save them in separate files")
    return models.pop()


def _refuse_lenses(cameras: Sequence[Camera]) -> None:
    for k, camera in enumerate(cameras):
        if camera.aperture > 0.0 or camera.camera_from_world_end is not None:
            feature = "an aperture" if camera.aperture > 0.0 else "a rolling shutter"
            raise SceneError(f"camera {k} ({camera.name}) has {feature}, which a transforms.json cannot hold")


def _model(values: Entry) -> CameraModel:
    """Returns the camera model that a frame of ``transforms.json`` states; a pinhole if it states none."""
    key = "camera_model" if "camera_model" in values else "camera_type"
    name = "OPENCV_FISHEYE" if values.get("is_fisheye") else values.get(key, "OPENCV")
    if not isinstance(name, str) or name.upper() not in _MODELS:
        raise SceneError(f"has {key} {quote(name)}, expected one of {', '.join(_MODELS)}")
    return _MODELS[name.upper()]


def _image_size(path: Path, values: Entry, fallback: tuple[int, int] | None) -> tuple[float, float]:
    """Returns width and height from the frame's values, else from the header of its image, else ``fallback``."""
    if "w" in values and "h" in values:
        return _number(values, "w"), _number(values, "h")
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
    """Returns the focal length in pixels from a field of view, 0.5 ``size`` / tan(0.5 angle).

    Args:
        values: The frame.
        angle_name: Key of the field of view in radians, ``camera_angle_x`` or ``camera_angle_y``.
        size: Width or height of the image, pixels.
        default: Result if the frame lacks the key; None raises `SceneError` instead.
    """
    if angle_name not in values:
        if default is None:
            raise SceneError("has no intrinsics: expected fl_x, or camera_angle_x")
        return default
    angle = _number(values, angle_name)
    if not 0.0 < angle < math.pi:
        raise SceneError(f"has {angle_name} {angle}, expected radians between 0 and pi")
    return 0.5 * size / math.tan(0.5 * angle)


def read_camera_json(path: PathLike, width: int | None = None, height: int | None = None) -> list[Camera]:
    """Reads the cameras of a JSON file; see `lumisplat.io.load_cameras`. Poses are converted to OpenCV axes."""
    path = Path(path)
    fallback = None if width is None or height is None else (width, height)
    with parsing(path, "a camera file (transforms.json or cameras.json)"):
        content = parse_json(path)
        if is_object(content) and is_list(entries := content.get("frames")):
            decode = partial(transforms_camera, path, content, fallback)
        elif is_object(content) and is_list(entries := content.get("camera_path")):
            decode = partial(_path_camera, content)
        elif is_list(content) and _is_inria(content):
            entries, decode = content, _inria_camera
        else:
            raise FormatError(
                path,
                "not a camera file: expected 'frames' (transforms.json), 'camera_path' (camera_path.json) "
                "or a list (cameras.json)",
            )
        if not entries:
            raise FormatError(path, "has no frames")
        return unique_names([decode_frame(path, k, entry, decode) for k, entry in enumerate(entries)])


def read_path_rate(path: PathLike) -> float | None:
    """Returns the frames per second of a ``camera_path.json``, or None for other camera files."""
    path = Path(path)
    with parsing(path, "a camera file"):
        content = parse_json(path)
        if is_object(content) and "camera_path" in content and "frames" not in content:
            try:
                return _path_rate(content)
            except SceneError as error:
                raise FormatError(path, str(error)) from None
    return None


def _is_inria(entries: list[Any]) -> bool:
    return not entries or any("rotation" in entry for entry in entries)


def parse_json(path: Path) -> object:
    """Parses a JSON file.

    Raises:
        FormatError: The file cannot be read, or is not JSON.
    """
    try:
        return json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise FormatError(
            path, f"invalid JSON at line {error.lineno}: {error.msg}; expected transforms.json or cameras.json"
        ) from None


def decode_frame(path: Path, index: int, entry: object, decode: Callable[[Entry], Camera]) -> Camera:
    """Creates the camera of a frame by ``decode``, and turns its errors into a `FormatError` that names the frame.

    Args:
        path: The camera file.
        index: Index of the frame.
        entry: JSON value of the frame.
        decode: Creates a camera from a JSON object.

    Raises:
        FormatError: The entry is not an object, or ``decode`` refuses it.
    """
    if not is_object(entry):
        raise FormatError(path, f"frame {index} is {quote(entry)}, expected an object with a pose")
    name = " ".join(str(entry.get("file_path", entry.get("img_name", ""))).split())
    try:
        return decode(entry)
    except FormatError:
        raise
    except KeyError as error:
        problem = f"lacks {error.args[0]}"
    except SceneError as error:
        problem = str(error)
    raise FormatError(path, f"frame {index}{f' ({name})' if name else ''} {problem}")
