"""Lists training images and their cameras: ``transforms.json``, and sparse models of COLMAP.

nerfstudio's ``transforms.json`` also names points of the scene, and which frames are for what.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.cameras.colmap import read_colmap_images
from lumisplat.io.cameras.json_cameras import (
    Entry,
    decode_frame,
    frame_image,
    is_list,
    is_object,
    parse_json,
    quote,
    transforms_camera,
)
from lumisplat.io.files.source import parsing, referenced_file
from lumisplat.io.ply import PlyRows, read_ply_element, read_ply_header
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.scene.camera import Camera

_log = logging.getLogger("lumisplat")

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
"""Extensions of images, and of masks."""

_MASK_ENDINGS = (".mask", "_mask", "-mask")
"""Ends of names, before the extension, that say that a file is a mask."""

_NAMES_LISTED = 3
"""How many names a message lists."""


@dataclass(frozen=True, slots=True)
class ListedImage:
    """A photograph that a file lists, and that is there."""

    camera: Camera
    """With its lens, of the size that the file says."""
    image: Path
    mask: Path | None
    name: str = ""
    """The ``file_path`` of its frame, in its shortest spelling."""


def transforms_images(path: Path, *, may_lack_all: bool = False) -> list[ListedImage]:
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
        found: list[ListedImage] = []
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
            found.append(ListedImage(camera, image, mask, _shortest_name(name)))
        if may_lack_all and not found:
            return []
        _report_missing(path, missing, len(frames), f"{path.parent} or its images")
        masks.report(found)
        return found


def _shortest_name(name: str) -> str:
    """Returns the shortest spelling of a ``file_path``, by which frames are told apart."""
    return str(PurePosixPath(name.replace("\\", "/")))


def colmap_images(model: Path, folder: Path) -> list[ListedImage]:
    """The photographs of a sparse model; those that are missing are left out, and a log line names them.

    Args:
        model: The folder of the model.
        folder: The one whose ``images`` the model is of; without it, the images are in the folder itself.

    Raises:
        FormatError: The model is damaged, or no image is there.
    """
    images = folder / "images" if (folder / "images").is_dir() else folder
    found: list[ListedImage] = []
    missing: list[str] = []
    masks = Masks(folder)
    listed = read_colmap_images(model)
    for camera, name in listed:
        with parsing(model, "a sparse model of COLMAP"):
            image = referenced_file(images / "images", name)
        if os.path.isfile(image):
            found.append(ListedImage(camera, image, masks.of(image)))
        else:
            missing.append(name)
    _report_missing(model, missing, len(listed), str(images))
    masks.report(found)
    return found


def report_without_pose(file: Path, folder: Path, listed: Sequence[ListedImage]) -> None:
    """Logs how many images lie beside those of a file without being listed in it, so that they have no pose.

    Args:
        file: The file, or the folder of the model, that lists images.
        folder: The folder of the set; its images are in ``images``, without that in the folder itself.
        listed: What the file lists.
    """
    images = folder / "images"
    files = _files_below(images) if images.is_dir() else [path for path in folder.iterdir() if path.is_file()]
    listed_paths = {os.path.abspath(one.image) for one in listed}
    candidates = [path for path in files if path.suffix.lower() in IMAGE_SUFFIXES and not _is_mask_name(path)]
    without_pose = sorted(path.name for path in candidates if os.path.abspath(path) not in listed_paths)
    if without_pose and len(without_pose) < len(candidates):
        _log.warning(
            "%s: %d of %d images have no pose (%s): left out",
            file,
            len(without_pose),
            len(candidates),
            some_names(without_pose),
        )


def _listed_mask(path: Path, name: object) -> Path | None:
    """The mask that a frame names."""
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
        self._folder = next((place for place in places if place.is_dir()), None)
        files = [] if self._folder is None else _files_below(self._folder)
        self._files = sorted(path for path in files if path.suffix.lower() in IMAGE_SUFFIXES)
        self._by_key = {
            _mask_key(path.relative_to(self._folder)): path for path in reversed(self._files) if self._folder
        }

    def of(self, image: Path) -> Path | None:
        """Returns the mask of an image; None: it has none."""
        relative = image.relative_to(self._images) if image.is_relative_to(self._images) else Path(image.name)
        for key in (relative, relative.with_suffix("")):
            if (found := self._by_key.get(str(key).lower())) is not None:
                return found
        beside = image.with_name(f"{image.name}.mask.png")
        return beside if beside.is_file() else None

    def report(self, listed: Sequence[ListedImage]) -> None:
        """Logs a line if a folder of masks has none for any of the images, or for some of them only."""
        masked = sum(one.mask is not None for one in listed)
        if not self._files or masked == len(listed):
            return
        if masked:
            _log.warning(
                "%s has masks of %d of %d images: the others count as a whole", self._folder, masked, len(listed)
            )
            return
        names, image = some_names([path.name for path in self._files]), listed[0].image
        _log.warning(
            "%s is ignored: none of its %d files (%s) is named after an image, expected such as %s.png or %s.mask.png",
            self._folder,
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
    """Logs which images are missing."""
    if not missing:
        return
    names = some_names(missing)
    if len(missing) == count:
        raise FormatError(path, f"none of its {count:,} photographs is there ({names}): expected them in {place}")
    _log.warning("%s: %d of %d photographs are not in %s (%s): left out", path, len(missing), count, place, names)


def some_names(names: Sequence[str]) -> str:
    """The first few names, for a message."""
    # Names of files may be bytes that are no text: such a line could not be printed.
    shown = (" ".join(name.split()).encode(errors="replace").decode() for name in names[:_NAMES_LISTED])
    return ", ".join(shown) + (", ..." if len(names) > _NAMES_LISTED else "")


@dataclass(frozen=True, slots=True)
class Splits:
    """The frames to learn from and to measure with, by their file paths; None: the file does not say."""

    training: frozenset[str] | None
    held_out: frozenset[str] | None

    @classmethod
    def of(cls, path: Path) -> Splits:
        """Those of a file: ``train_filenames``, and ``test_filenames``, else ``val_filenames``.

        Raises:
            FormatError: One of them is no list of names.
        """
        content = _content(path)
        training, test, validation = (_names(path, content, f"{part}_filenames") for part in ("train", "test", "val"))
        return cls(training, validation if test is None else test)

    def divide(
        self, path: Path, listed: list[ListedImage], *, holds_out: bool
    ) -> tuple[list[ListedImage], list[ListedImage] | None]:
        """Frames to learn from, and to measure with; None: the file does not say which.

        Args:
            path: The file.
            listed: All of its frames.
            holds_out: Whether any are wanted to measure with.

        Raises:
            FormatError: No frame is left to learn from.
        """
        if self.training is None and self.held_out is None:
            return listed, None
        held_out = self.held_out or frozenset()
        training = [one for one in listed if (one.name in self.training if self.training else one.name not in held_out)]
        if not training:
            raise FormatError(path, "has none of the frames that its train_filenames name")
        if self.held_out is None:
            rest = [one for one in listed if one not in training]
        else:
            rest = [one for one in listed if one.name in held_out and one not in training]
        return training, rest if holds_out else []


def nerfstudio_points(path: Path) -> tuple[Doubles, FloatArray] | None:
    """The points of ``ply_file_path``; None: it names none, or they are not there, of which a log line tells.

    Returns:
        Positions in world space, shape (N, 3), and display-referred colours, 0..1, shape (N, 3), grey without any.

    Raises:
        FormatError: The file is damaged, or has a position that is not finite.
    """
    name = _content(path).get("ply_file_path")
    if name is None:
        return None
    file = referenced_file(path, str(name))
    if not os.path.isfile(file):
        _log.warning("%s: its ply_file_path %s is not there: training begins at random points", path, quote(name))
        return None
    with parsing(file, "points of photographs"):
        header = read_ply_header(file)
        rows = read_ply_element(header, header.required("vertex"))
        if not {"x", "y", "z"} <= set(rows.dtype.names or ()):
            raise FormatError(file, "has no x, y and z: expected points")
        positions = _columns(rows, ("x", "y", "z"))
        if not len(positions):
            return None
        if not np.isfinite(positions).all():
            raise FormatError(file, "has points whose positions are not finite")
        return positions, _colors(rows)


def _colors(rows: PlyRows) -> FloatArray:
    names = ("red", "green", "blue")
    if not set(names) <= set(rows.dtype.names or ()):
        return np.full((len(rows), 3), 0.5, np.float32)
    colors = _columns(rows, names)
    largest = 255.0 if rows.dtype["red"].kind in "iu" else 1.0
    return np.clip(colors / largest, 0.0, 1.0).astype(np.float32)


def _columns(rows: PlyRows, names: tuple[str, ...]) -> np.ndarray:
    return np.stack([rows[name].astype(np.float64) for name in names], axis=1)


def _content(path: Path) -> Entry:
    with parsing(path, "a transforms.json of photographs"):
        content = parse_json(path)
    return content if is_object(content) else {}


def _names(path: Path, content: Entry, key: str) -> frozenset[str] | None:
    names = content.get(key)
    if names is None:
        return None
    if not is_list(names) or not all(isinstance(name, str) for name in names):
        raise FormatError(path, f"{key} is {quote(names)}, expected a list of the file_path of frames")
    return frozenset(_shortest_name(str(name)) for name in names)
