"""Camera files: nerfstudio / instant-ngp / NeRF `transforms.json` and INRIA `cameras.json`.

Poses become `camera_from_world` with OpenCV axes (x right, y down, z forward) here, at the door.
"""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike, parsing, read_bytes
from lumisplat.scene.camera import Camera, CameraModel

_log = logging.getLogger("lumisplat")

_OPENGL_FROM_OPENCV = np.diag((1.0, -1.0, -1.0, 1.0))
"""OpenGL cameras look along -z with y up. Its own inverse."""

_IMAGE_EXTENSIONS = ("", ".png", ".jpg", ".jpeg")
"""What NeRF's synthetic scenes leave off their file names, in the order tried."""

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr", ".heic")

_MODELS = {
    "OPENCV": CameraModel.PINHOLE,
    "PINHOLE": CameraModel.PINHOLE,
    "SIMPLE_PINHOLE": CameraModel.PINHOLE,
    "PERSPECTIVE": CameraModel.PINHOLE,
    "OPENCV_FISHEYE": CameraModel.FISHEYE,
    "FISHEYE": CameraModel.FISHEYE,
    "ORTHOPHOTO": CameraModel.ORTHOGRAPHIC,
}
"""By nerfstudio's names. The first one of each model is written."""

_DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")


def load_cameras(path: PathLike, width: int | None = None, height: int | None = None) -> list[Camera]:
    """See `lumisplat.io.load_cameras`."""
    path = Path(path)
    fallback = None if width is None or height is None else (width, height)
    with parsing(path, "a camera file (transforms.json or cameras.json)"):
        try:
            content = json.loads(read_bytes(path).decode("utf-8-sig"))
        except json.JSONDecodeError as error:
            raise FormatError(
                path, f"invalid JSON at line {error.lineno}: {error.msg}; expected transforms.json or cameras.json"
            ) from None
        if isinstance(content, dict) and isinstance(content.get("frames"), list):
            _check_lenses(path, content)
            entries, decode = content["frames"], lambda frame: _nerfstudio_camera(path, content, frame, fallback)
        elif isinstance(content, list) and (not content or any("rotation" in entry for entry in content)):
            entries, decode = content, _inria_camera
        else:
            raise FormatError(path, "not a camera file: expected 'frames' (transforms.json) or a list (cameras.json)")
        if not entries:
            raise FormatError(path, "has no frames")
        return unique_names([_decoded(path, k, entry, decode) for k, entry in enumerate(entries)])


def save_cameras(path: PathLike, cameras: Sequence[Camera]) -> None:
    """See `lumisplat.io.save_cameras`."""
    if not cameras:
        raise SceneError("no cameras to save")
    models = {camera.model for camera in cameras}
    if len(models) > 1:
        names = " and ".join(sorted(model.value for model in models))
        raise SceneError(f"a transforms.json holds cameras of one model, these are {names}: save them apart")
    for k, camera in enumerate(cameras):
        if camera.aperture > 0.0 or camera.camera_from_world_end is not None:
            what = "an aperture" if camera.aperture > 0.0 else "a rolling shutter"
            raise SceneError(f"camera {k} ({camera.name}) has {what}, which a transforms.json cannot hold")
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
            "transform_matrix": (_inverse_rigid(camera.camera_from_world) @ _OPENGL_FROM_OPENCV).tolist(),
        }
        for k, camera in enumerate(cameras)
    ]
    model = next(name for name, model in _MODELS.items() if model in models)
    text = json.dumps({"camera_model": model, "frames": frames}, indent=1)
    with atomic_write(path) as temporary:
        Path(temporary).write_text(text + "\n", encoding="utf-8")


def _decoded(path: Path, index: int, entry: Any, decode: Callable[[Any], Camera]) -> Camera:
    """Decodes one entry; whatever is wrong with it is said about that frame."""
    if not isinstance(entry, dict):
        raise FormatError(path, f"frame {index} is {_shown(entry)}, expected an object with a pose")
    name = str(entry.get("file_path", entry.get("img_name", "")))
    try:
        return decode(entry)
    except FormatError:
        raise
    except KeyError as error:
        problem = f"lacks {error.args[0]}"
    except SceneError as error:
        problem = str(error)
    raise FormatError(path, f"frame {index}{f' ({name})' if name else ''} {problem}")


def _check_lenses(path: Path, content: Mapping[str, Any]) -> None:
    """Says which distortions are ignored, once for the whole file."""
    frames = [frame for frame in content["frames"] if isinstance(frame, dict)]
    distorted = [name for name in _DISTORTIONS if any(values.get(name) for values in (content, *frames))]
    if distorted:
        _log.warning("%s: lens distortion (%s) is ignored", path, ", ".join(distorted))


def _model(values: Mapping[str, Any]) -> CameraModel:
    """The model of a frame.

    Raises:
        SceneError: It is none of ours.
    """
    key = "camera_model" if "camera_model" in values else "camera_type"
    name = "OPENCV_FISHEYE" if values.get("is_fisheye") else values.get(key, "OPENCV")
    if not isinstance(name, str) or name.upper() not in _MODELS:
        raise SceneError(f"has {key} {_shown(name)}, expected one of {', '.join(_MODELS)}")
    return _MODELS[name.upper()]


def _nerfstudio_camera(
    path: Path, shared: Mapping[str, Any], frame: Mapping[str, Any], fallback: tuple[int, int] | None
) -> Camera:
    values = {**shared, **frame}
    rows = values["transform_matrix"]
    pose = _numbers(rows, (len(rows) if isinstance(rows, list) and len(rows) == 3 else 4, 4), "transform_matrix")
    world_from_camera = _rigid(pose) @ _OPENGL_FROM_OPENCV
    width, height = _image_size(path, values, fallback)
    model = _model(values)
    angles = values if model is CameraModel.PINHOLE else {}  # others have no agreed meaning for them
    fx = _number(values, "fl_x") if "fl_x" in values or not angles else _focal(angles, "camera_angle_x", width)
    fy = _number(values, "fl_y") if "fl_y" in values else _focal(angles, "camera_angle_y", height, default=fx)
    return Camera(
        width=width,  # type: ignore[arg-type] # whole numbers, or refused there
        height=height,  # type: ignore[arg-type]
        fx=fx,
        fy=fy,
        cx=_number(values, "cx") if "cx" in values else 0.5 * width,
        cy=_number(values, "cy") if "cy" in values else 0.5 * height,
        camera_from_world=_inverse_rigid(world_from_camera),
        name=_frame_name(values.get("file_path", "")),
        model=model,
    )


def _inria_camera(entry: Mapping[str, Any]) -> Camera:
    width, height = _number(entry, "width"), _number(entry, "height")
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = _numbers(entry["rotation"], (3, 3), "rotation")
    world_from_camera[:3, 3] = _numbers(entry["position"], (3,), "position")
    return Camera(
        width=width,  # type: ignore[arg-type] # whole numbers, or refused there
        height=height,  # type: ignore[arg-type]
        fx=_number(entry, "fx"),
        fy=_number(entry, "fy"),
        cx=0.5 * width,
        cy=0.5 * height,
        camera_from_world=_inverse_rigid(_rigid(world_from_camera)),
        name=_frame_name(entry.get("img_name", "")),
    )


def _number(values: Mapping[str, Any], name: str) -> float:
    """The number called ``name``.

    Raises:
        SceneError: It is none.
    """
    value = values[name]
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise SceneError(f"has {name} {_shown(value)}, expected a number")
    return value


def _numbers(values: Any, shape: tuple[int, ...], name: str) -> npt.NDArray[np.float64]:
    """Finite numbers in an array of the given shape.

    Raises:
        SceneError: They are not.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise SceneError(f"has {name} {_shown(values)}, expected {' x '.join(map(str, shape))} finite numbers")
    return array


def _shown(value: Any) -> str:
    """JSON for a message, cut short."""
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _rigid(matrix: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """A pose whose rotation is one to rounding error, made exact.

    Raises:
        SceneError: The matrix is singular, scaled, sheared or mirrored.
    """
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


def _inverse_rigid(matrix: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse


def _image_size(path: Path, values: Mapping[str, Any], fallback: tuple[int, int] | None) -> tuple[float, float]:
    """From the file; otherwise from the header of the frame's image; otherwise the fallback."""
    if "w" in values and "h" in values:
        return _number(values, "w"), _number(values, "h")
    from PIL import Image

    stem = str(values.get("file_path", ""))
    for extension in _IMAGE_EXTENSIONS:
        image_path = path.parent / (stem + extension)
        if image_path.is_file():
            try:
                with Image.open(image_path) as image:
                    return image.size
            except Exception as error:  # Pillow raises whatever the format's parser does
                raise FormatError(image_path, "cannot be read for its size: expected PNG or JPEG") from error
    if fallback is not None:
        return fallback
    raise SceneError(
        f"has no w and h, and there is no image {stem!r} to take them from: "
        "add them, or give --width and --height (width=, height=)"
    )


def _focal(values: Mapping[str, Any], angle_name: str, size: float, default: float | None = None) -> float:
    """Focal length in pixels of a field of view in radians."""
    if angle_name not in values:
        if default is None:
            raise SceneError("has no intrinsics: expected fl_x, or camera_angle_x")
        return default
    angle = _number(values, angle_name)
    if not 0.0 < angle < math.pi:
        raise SceneError(f"has {angle_name} {angle}, expected radians between 0 and pi")
    return 0.5 * size / math.tan(0.5 * angle)


def _frame_name(image: object) -> str:
    """The image's file name without its extension: `images/0001.png` -> `0001`; other dots stay."""
    name = str(image).replace("\\", "/").rstrip("/").rpartition("/")[2]
    return name[: -len(Path(name).suffix)] if Path(name).suffix.lower() in _IMAGE_SUFFIXES else name


def unique_names(cameras: list[Camera]) -> list[Camera]:
    """Empty names become `frame_00000`; repeated ones get a number."""
    used: set[str] = set()
    named = []
    for index, camera in enumerate(cameras):
        base = camera.name or f"frame_{index:05d}"
        name, copy = base, 1
        while name in used:
            copy += 1
            name = f"{base}_{copy}"
        used.add(name)
        named.append(replace(camera, name=name))
    return named
