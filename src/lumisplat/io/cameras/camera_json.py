"""JSON camera files, recognised by their content: nerfstudio's `transforms.json` and `camera_path.json`, INRIA's."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.cameras.camera_path_json import path_camera, path_rate
from lumisplat.io.cameras.inria_json import inria_camera
from lumisplat.io.cameras.json_values import Entry, is_list, is_object, quote
from lumisplat.io.cameras.names import unique_names
from lumisplat.io.cameras.transforms_json import transforms_camera
from lumisplat.io.files.source import PathLike, parsing, read_text
from lumisplat.scene.camera import Camera


def read_camera_json(path: PathLike, width: int | None = None, height: int | None = None) -> list[Camera]:
    """As `lumisplat.io.load_cameras`, for JSON files. Poses become `camera_from_world` with OpenCV axes."""
    path = Path(path)
    fallback = None if width is None or height is None else (width, height)
    with parsing(path, "a camera file (transforms.json or cameras.json)"):
        content = parse_json(path)
        if is_object(content) and is_list(entries := content.get("frames")):
            decode = partial(transforms_camera, path, content, fallback)
        elif is_object(content) and is_list(entries := content.get("camera_path")):
            decode = partial(path_camera, content)
        elif is_list(content) and _is_inria(content):
            entries, decode = content, inria_camera
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
    """Frames a second of a `camera_path.json`; None: it is another camera file."""
    path = Path(path)
    with parsing(path, "a camera file"):
        content = parse_json(path)
        if is_object(content) and "camera_path" in content and "frames" not in content:
            try:
                return path_rate(content)
            except SceneError as error:
                raise FormatError(path, str(error)) from None
    return None


def _is_inria(entries: list[Any]) -> bool:
    return not entries or any("rotation" in entry for entry in entries)


def parse_json(path: Path) -> object:
    """The content of a JSON file.

    Raises:
        FormatError: It cannot be read, or is no JSON.
    """
    try:
        return json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise FormatError(
            path, f"invalid JSON at line {error.lineno}: {error.msg}; expected transforms.json or cameras.json"
        ) from None


def decode_frame(path: Path, index: int, entry: object, decode: Callable[[Entry], Camera]) -> Camera:
    """Decodes one entry.

    Raises:
        FormatError: It is no object, or ``decode`` refuses it; names the frame.
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
