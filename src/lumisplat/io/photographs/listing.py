"""Which photographs a file lists, and with which cameras: ``transforms.json``, and sparse models of COLMAP."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

from lumisplat.errors import FormatError
from lumisplat.io.cameras.camera_json import decode_frame, parse_json
from lumisplat.io.cameras.colmap import read_colmap_images
from lumisplat.io.cameras.json_values import is_list, is_object, quote
from lumisplat.io.cameras.transforms_json import frame_image, transforms_camera
from lumisplat.io.files.references import referenced_file
from lumisplat.io.files.source import parsing
from lumisplat.scene.camera import Camera

_log = logging.getLogger("lumisplat")

_SHOWN = 3
"""How many names a message lists."""


@dataclass(frozen=True, slots=True)
class Listed:
    """A photograph that a file lists, and that is there."""

    camera: Camera
    """With its lens, of the size that the file says."""
    image: Path
    mask: Path | None
    name: str = ""
    """The ``file_path`` of its frame, in its shortest spelling."""


def transforms_photographs(path: Path) -> list[Listed]:
    """The photographs of a ``transforms.json``; those that are missing are left out, and a log line names them.

    Raises:
        FormatError: The file is malformed, a frame has no valid pose or intrinsics, or no image is there.
    """
    with parsing(path, "a transforms.json of photographs"):
        content = parse_json(path)
        frames = content.get("frames") if is_object(content) else None
        if not is_object(content) or not is_list(frames) or not frames:
            raise FormatError(path, "lists no photographs: expected 'frames', each with file_path and transform_matrix")
        found: list[Listed] = []
        missing: list[str] = []
        for index, entry in enumerate(frames):
            values = entry if is_object(entry) else {}
            name = str(values.get("file_path", f"frame {index} without a file_path"))
            referenced_file(path, name)
            image = frame_image(path.parent, values)
            if is_object(entry) and image is None:
                missing.append(name)
                continue
            camera = decode_frame(path, index, entry, partial(transforms_camera, path, content, None))
            assert image is not None
            mask = _listed_mask(path, values.get("mask_path")) or _mask_beside(path.parent, image)
            found.append(Listed(camera, image, mask, str(PurePosixPath(name))))
        _report_missing(path, missing, len(frames), f"{path.parent} or its images")
        return found


def colmap_photographs(model: Path, folder: Path) -> list[Listed]:
    """The photographs of a sparse model; those that are missing are left out, and a log line names them.

    Args:
        model: The folder of the model.
        folder: The one whose ``images`` the model is of; without it, the images are in the folder itself.

    Raises:
        FormatError: The model is damaged, or no image is there.
    """
    images = folder / "images" if (folder / "images").is_dir() else folder
    found: list[Listed] = []
    missing: list[str] = []
    listed = read_colmap_images(model)
    for camera, name in listed:
        with parsing(model, "a sparse model of COLMAP"):
            image = referenced_file(images / "images", name)
        if os.path.isfile(image):
            found.append(Listed(camera, image, _mask_beside(folder, image)))
        else:
            missing.append(name)
    _report_missing(model, missing, len(listed), str(images))
    return found


def _listed_mask(path: Path, name: object) -> Path | None:
    """The mask that a frame names.

    Raises:
        FormatError: It is not there.
    """
    if name is None:
        return None
    mask = referenced_file(path, str(name))
    if not os.path.isfile(mask):
        raise FormatError(path, f"names the mask {quote(name)}, which is not there")
    return mask


def _mask_beside(folder: Path, image: Path) -> Path | None:
    """The mask of an image in ``masks``: of its name, with .png in place of its extension or after it."""
    images = folder / "images"
    relative = image.relative_to(images) if image.is_relative_to(images) else Path(image.name)
    candidates = (folder / "masks" / name for name in (relative.with_suffix(".png"), f"{relative}.png"))
    return next((path for path in candidates if os.path.isfile(path)), None)


def _report_missing(path: Path, missing: Sequence[str], count: int, place: str) -> None:
    """Logs which images are missing.

    Raises:
        FormatError: All are.
    """
    if not missing:
        return
    names = some_names(missing)
    if len(missing) == count:
        raise FormatError(path, f"none of its {count:,} photographs is there ({names}): expected them in {place}")
    _log.warning("%s: %d of %d photographs are not in %s (%s): left out", path, len(missing), count, place, names)


def some_names(names: Sequence[str]) -> str:
    """The first few names, for a message."""
    # Names of files may be bytes that are no text: such a line could not be printed.
    shown = (" ".join(name.split()).encode(errors="replace").decode() for name in names[:_SHOWN])
    return ", ".join(shown) + (", ..." if len(names) > _SHOWN else "")
