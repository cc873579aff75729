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

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
"""Extensions of images, and of masks."""

_MASK_ENDINGS = (".mask", "_mask", "-mask")
"""Ends of names, before the extension, that say that a file is a mask."""

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


def transforms_photographs(path: Path, *, may_lack_all: bool = False) -> list[Listed]:
    """Lists the images of a ``transforms.json``; those that are missing are left out, and a log line names them.

    Args:
        path: The file.
        may_lack_all: Whether none of them has to be there; then nothing is logged of such a file.

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
        masks = Masks(path.parent)
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
            mask = _listed_mask(path, values.get("mask_path")) or masks.of(image)
            found.append(Listed(camera, image, mask, shortest_name(name)))
        if may_lack_all and not found:
            return []
        _report_missing(path, missing, len(frames), f"{path.parent} or its images")
        masks.report(found)
        return found


def shortest_name(name: str) -> str:
    """Returns the shortest spelling of a ``file_path``, by which frames are told apart."""
    return str(PurePosixPath(name.replace("\\", "/")))


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
    masks = Masks(folder)
    listed = read_colmap_images(model)
    for camera, name in listed:
        with parsing(model, "a sparse model of COLMAP"):
            image = referenced_file(images / "images", name)
        if os.path.isfile(image):
            found.append(Listed(camera, image, masks.of(image)))
        else:
            missing.append(name)
    _report_missing(model, missing, len(listed), str(images))
    masks.report(found)
    return found


def report_without_pose(file: Path, folder: Path, listed: Sequence[Listed]) -> None:
    """Logs how many images lie beside those of a file without being listed in it, so that they have no pose.

    Args:
        file: The file, or the folder of the model, that lists images.
        folder: The folder of the set; its images are in ``images``, without that in the folder itself.
        listed: What the file lists.
    """
    images = folder / "images"
    there = _files_below(images) if images.is_dir() else [path for path in folder.iterdir() if path.is_file()]
    known = {os.path.abspath(one.image) for one in listed}
    pictures = [path for path in there if path.suffix.lower() in IMAGE_SUFFIXES and not _is_mask_name(path)]
    lost = sorted(path.name for path in pictures if os.path.abspath(path) not in known)
    if lost and len(lost) < len(pictures):
        _log.warning(
            "%s: %d of %d images have no pose (%s): left out", file, len(lost), len(pictures), some_names(lost)
        )


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


class Masks:
    """Finds the masks of a set: files of ``masks`` (or ``mask``) that are named after images, as several programs do.

    For ``images/a/1.jpg`` in ``masks/a``: ``1.png`` and ``1.jpg.png`` (COLMAP, nerfstudio), ``1.jpg.mask.png``
    (RealityScan, also beside the image), ``1.mask.png``, ``1_mask.png`` and ``1-mask.png``, with any extension of
    images.

    Args:
        folder: The folder of the set.
    """

    def __init__(self, folder: Path) -> None:
        self._images = folder / "images"
        places = (folder / name for name in ("masks", "mask"))
        self._place = next((place for place in places if place.is_dir()), None)
        files = [] if self._place is None else _files_below(self._place)
        self._files = sorted(path for path in files if path.suffix.lower() in IMAGE_SUFFIXES)
        self._by_key = {_mask_key(path.relative_to(self._place)): path for path in reversed(self._files) if self._place}

    def of(self, image: Path) -> Path | None:
        """Returns the mask of an image; None: it has none."""
        relative = image.relative_to(self._images) if image.is_relative_to(self._images) else Path(image.name)
        for key in (relative, relative.with_suffix("")):
            if (found := self._by_key.get(str(key).lower())) is not None:
                return found
        beside = image.with_name(f"{image.name}.mask.png")
        return beside if beside.is_file() else None

    def report(self, listed: Sequence[Listed]) -> None:
        """Logs a line if a folder of masks has none for any of the images, or for some of them only."""
        masked = sum(one.mask is not None for one in listed)
        if not self._files or masked == len(listed):
            return
        if masked:
            _log.warning(
                "%s has masks of %d of %d images: the others count as a whole", self._place, masked, len(listed)
            )
            return
        names, image = some_names([path.name for path in self._files]), listed[0].image
        _log.warning(
            "%s is ignored: none of its %d files (%s) is named after an image, expected such as %s.png or %s.mask.png",
            self._place,
            len(self._files),
            names,
            image.stem,
            image.name,
        )


def _mask_key(name: Path) -> str:
    """Returns the name of the image that a mask is named after, in lower case; with its extension if that is in it."""
    stem = name.with_suffix("")
    for ending in _MASK_ENDINGS:
        if stem.name.lower().endswith(ending) and len(stem.name) > len(ending):
            stem = stem.with_name(stem.name[: -len(ending)])
            break
    return str(stem).lower()


def _is_mask_name(path: Path) -> bool:
    return path.stem.lower().endswith(_MASK_ENDINGS)


def _files_below(folder: Path) -> list[Path]:
    """Returns all files of a folder and its folders."""
    return [Path(place) / name for place, _, names in os.walk(folder) for name in names]


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
