"""Lists the images, masks and cameras that a ``transforms.json`` or a COLMAP sparse model refers to.

Also reads the train and test splits and the point cloud that nerfstudio's ``transforms.json`` may name.
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
"""File extensions of images and masks."""

_MASK_ENDINGS = (".mask", "_mask", "-mask")
"""Endings of mask file names before the extension, such as ``_mask`` in ``1_mask.png``."""

_NAMES_LISTED = 3
"""Largest number of file names that a message lists."""


@dataclass(frozen=True, slots=True)
class ListedImage:
    """An image that a transforms file or a COLMAP model lists, and that exists on disk."""

    camera: Camera
    """Camera of the image, with lens distortion and with the image size that the file states."""
    image: Path
    mask: Path | None
    name: str = ""
    """``file_path`` of the frame, normalised by `_shortest_name`; empty for COLMAP models."""


def transforms_images(path: Path, *, may_lack_all: bool = False) -> list[ListedImage]:
    """Lists the images of a ``transforms.json``. Missing images are skipped, and a log line names them.

    Args:
        path: The ``transforms.json``.
        may_lack_all: Whether to return an empty list, without a log line, if every image of the file is missing.

    Raises:
        FormatError: The file is malformed, a frame has no valid pose or intrinsics, or all images are missing and
            ``may_lack_all`` is False.
    """
    with parsing(path, "a transforms.json of training images"):
        content = parse_json(path)
        frames = content.get("frames") if is_object(content) else None
        if not is_object(content) or not is_list(frames) or not frames:
            raise FormatError(path, "lists no images: expected 'frames', each with file_path and transform_matrix")
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


_VIEW_IMAGES = ("rgba.png", "rgba_sunset_000.png", "rgba_sunset.png")
"""Names of the image in the light of training, in folders of single views: NeRFactor's, then TensoIR's."""


def view_folder_images(folder: Path, split: str) -> list[ListedImage]:
    """Lists the images of folders of single views, such as ``train_000``, each with a ``metadata.json``.

    NeRFactor (Zhang et al. 2021) and TensoIR (Jin et al. 2023) publish such folders. Cameras are named after them.

    Args:
        folder: Folder that holds them.
        split: ``train`` or ``test``.

    Raises:
        FormatError: There is no such folder, or its metadata.json is damaged or its image missing.
    """
    files = sorted(folder.glob(f"{split}_*/metadata.json"))
    if not files:
        raise FormatError(folder, f"has no {split}_000/metadata.json: expected a folder for each view")
    found: list[ListedImage] = []
    for index, file in enumerate(files):
        image = next((path for name in _VIEW_IMAGES if (path := file.with_name(name)).is_file()), None)
        if image is None:
            raise FormatError(file.parent, f"has no image of the training light: expected {', '.join(_VIEW_IMAGES)}")
        with parsing(file, "the metadata.json of a view"):
            content = parse_json(file)
            values = content if is_object(content) else {}
            rows = [float(value) for value in str(values["cam_transform_mat"]).split(",")]
            entry = {
                "file_path": file.parent.name,
                "transform_matrix": [rows[4 * k : 4 * k + 4] for k in range(4)],
                "camera_angle_x": values["cam_angle_x"],
                "w": values["imw"],
                "h": values["imh"],
            }
        camera = decode_frame(file, index, entry, partial(transforms_camera, file, {}, None))
        found.append(ListedImage(camera, image, None, file.parent.name))
    return found


def _shortest_name(name: str) -> str:
    r"""Normalises a ``file_path`` (``./a\b`` to ``a/b``), so that names of the same frame compare equal."""
    return str(PurePosixPath(name.replace("\\", "/")))


def colmap_images(model: Path, folder: Path) -> list[ListedImage]:
    """Lists the images of a COLMAP sparse model. Missing images are skipped, and a log line names them.

    Args:
        model: Folder of the model.
        folder: Folder of the image set. Image names are relative to its ``images`` subfolder, or to the folder itself
            if it has no ``images``.

    Raises:
        FormatError: The model is damaged, or all images are missing.
    """
    images = folder / "images" if (folder / "images").is_dir() else folder
    found: list[ListedImage] = []
    missing: list[str] = []
    masks = Masks(folder)
    listed = read_colmap_images(model)
    for camera, name in listed:
        with parsing(model, "a COLMAP sparse model"):
            image = referenced_file(images / "images", name)
        if os.path.isfile(image):
            found.append(ListedImage(camera, image, masks.of(image)))
        else:
            missing.append(name)
    _report_missing(model, missing, len(listed), str(images))
    masks.report(found)
    return found


def report_without_pose(file: Path, folder: Path, listed: Sequence[ListedImage]) -> None:
    """Logs how many images of the folder are not listed in the file, and so have no pose.

    Args:
        file: The transforms file or the model folder, named in the log line.
        folder: Folder of the image set. Images are searched in its ``images`` subfolder, or in the folder itself if it
            has no ``images``.
        listed: The images that the file lists.
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
    """Returns the mask that a frame's ``mask_path`` names, or None if the frame has no ``mask_path``."""
    if name is None:
        return None
    mask = referenced_file(path, str(name))
    if not os.path.isfile(mask):
        raise FormatError(path, f"names the mask {quote(name)}, which does not exist")
    return mask


class Masks:
    """Finds mask files in the ``masks`` (or ``mask``) subfolder by the names of their images.

    Recognised names for ``images/a/1.jpg``, in ``masks/a``: ``1.png`` and ``1.jpg.png`` (COLMAP, nerfstudio),
    ``1.jpg.mask.png`` (RealityScan, also beside the image), ``1.mask.png``, ``1_mask.png`` and ``1-mask.png``, with any
    image extension in place of ``.png``.

    Args:
        folder: Folder of the image set.
    """

    def __init__(self, folder: Path) -> None:
        self._images = folder / "images"
        folders = (folder / name for name in ("masks", "mask"))
        self._folder = next((candidate for candidate in folders if candidate.is_dir()), None)
        files = [] if self._folder is None else _files_below(self._folder)
        self._files = sorted(path for path in files if path.suffix.lower() in IMAGE_SUFFIXES)
        self._by_key = {
            _mask_key(path.relative_to(self._folder)): path for path in reversed(self._files) if self._folder
        }

    def of(self, image: Path) -> Path | None:
        """Returns the mask file of an image, or None if the image has no mask."""
        relative = image.relative_to(self._images) if image.is_relative_to(self._images) else Path(image.name)
        for key in (relative, relative.with_suffix("")):
            if (found := self._by_key.get(str(key).lower())) is not None:
                return found
        beside = image.with_name(f"{image.name}.mask.png")
        return beside if beside.is_file() else None

    def report(self, listed: Sequence[ListedImage]) -> None:
        """Logs a line if the mask folder has masks for only some of the images, or for none of them."""
        masked = sum(one.mask is not None for one in listed)
        if not self._files or masked == len(listed):
            return
        if masked:
            _log.warning(
                "%s has masks for only %d of %d images: the other images are used without a mask",
                self._folder,
                masked,
                len(listed),
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
    """Returns the name of the image that a mask is for, in lower case: ``a/1`` for ``a/1_mask.png`` and ``a/1.png``.

    For ``a/1.jpg.png`` it is ``a/1.jpg``, with the image's extension.
    """
    stem = name.with_suffix("")
    for ending in _MASK_ENDINGS:
        if stem.name.lower().endswith(ending) and len(stem.name) > len(ending):
            stem = stem.with_name(stem.name[: -len(ending)])
            break
    return str(stem).lower()


def _is_mask_name(path: Path) -> bool:
    return path.stem.lower().endswith(_MASK_ENDINGS)


def _files_below(folder: Path) -> list[Path]:
    """Lists all files in a folder and its subfolders."""
    return [Path(parent) / name for parent, _, names in os.walk(folder) for name in names]


def _report_missing(path: Path, missing: Sequence[str], count: int, expected: str) -> None:
    """Logs the missing images, or raises `FormatError` if all images are missing.

    Args:
        path: The file that lists the images.
        missing: Names of the missing images.
        count: Number of all images.
        expected: Where the images were searched, for the message.
    """
    if not missing:
        return
    names = some_names(missing)
    if len(missing) == count:
        raise FormatError(path, f"none of its {count:,} images exists ({names}): expected them in {expected}")
    _log.warning("%s: %d of %d images are missing in %s (%s): left out", path, len(missing), count, expected, names)


def some_names(names: Sequence[str]) -> str:
    """Joins the first three names for a message, with "..." if there are more."""
    # File names may contain bytes that are not valid text and could not be printed.
    printable = (" ".join(name.split()).encode(errors="replace").decode() for name in names[:_NAMES_LISTED])
    return ", ".join(printable) + (", ..." if len(names) > _NAMES_LISTED else "")


@dataclass(frozen=True, slots=True)
class Splits:
    """Train and evaluation splits of a ``transforms.json``: sets of ``file_path``, None for an undefined split."""

    training: frozenset[str] | None
    held_out: frozenset[str] | None

    @classmethod
    def of(cls, path: Path) -> Splits:
        """Reads ``train_filenames`` and ``test_filenames`` of a file; ``val_filenames`` replaces a missing test split.

        Raises:
            FormatError: One of these keys is not a list of names.
        """
        content = _content(path)
        training, test, validation = (_names(path, content, f"{part}_filenames") for part in ("train", "test", "val"))
        return cls(training, validation if test is None else test)

    def divide(
        self, path: Path, listed: list[ListedImage], *, holds_out: bool
    ) -> tuple[list[ListedImage], list[ListedImage] | None]:
        """Divides frames into training frames and held-out frames.

        If a file defines only one of the two sets, all frames outside of that set form the other set.

        Args:
            path: The file, named in errors.
            listed: All frames of the file.
            holds_out: Whether to return held-out frames; False returns an empty list for them.

        Returns:
            Training frames and held-out frames. The held-out frames are None if the file defines neither set.

        Raises:
            FormatError: No training frame is left.
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
    """Reads the point cloud that ``ply_file_path`` names; returns None if there is no such key or no such file.

    A log line reports a missing file.

    Returns:
        Positions in world space, shape (N, 3), and display-referred colours, 0..1, shape (N, 3). Colours are grey if
        the file has none.

    Raises:
        FormatError: The file is damaged, or has a position that is not finite.
    """
    name = _content(path).get("ply_file_path")
    if name is None:
        return None
    file = referenced_file(path, str(name))
    if not os.path.isfile(file):
        _log.warning("%s: its ply_file_path %s does not exist: training starts from random points", path, quote(name))
        return None
    with parsing(file, "a point cloud of training images"):
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
    with parsing(path, "a transforms.json of training images"):
        content = parse_json(path)
    return content if is_object(content) else {}


def _names(path: Path, content: Entry, key: str) -> frozenset[str] | None:
    names = content.get(key)
    if names is None:
        return None
    if not is_list(names) or not all(isinstance(name, str) for name in names):
        raise FormatError(path, f"{key} is {quote(names)}, expected a list of the file_path of frames")
    return frozenset(_shortest_name(str(name)) for name in names)
