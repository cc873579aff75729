"""Writes the files that describe a whole data set: cameras, layers and categories, a contact sheet, and shards.

Shards are in the format of WebDataset: tar files in which the members of one view begin with the view's name.
"""

from __future__ import annotations

import io
import json
import os
import tarfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lumisplat.config import DatasetConfig
from lumisplat.config.checks import check_kind
from lumisplat.dataset.files import LAYER_FILES, view_file, view_name
from lumisplat.errors import FormatError
from lumisplat.io.cameras.json_cameras import OPENGL_FROM_OPENCV
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import readable
from lumisplat.math.arrays import FloatArray

if TYPE_CHECKING:
    from PIL import Image


_AXES = "cameras: x right, y down, z forward (OpenCV); camera_from_world takes column vectors; lengths in scene units"


@dataclass(frozen=True, kw_only=True)
class DatasetSummary:
    """Result of `finish_dataset`: numbers of views in each split, of missing views, and of objects not inserted."""

    train: int
    """Number of training views."""
    val: int
    """Number of validation views."""
    test: int
    """Number of test views."""
    missing: int
    """Number of views not rendered yet; if it is above 0, no summary file was written."""
    left_out: int
    """Number of objects in all views that were left out because no free position was found."""
    shards: tuple[Path, ...] = ()


def finish_dataset(folder: str | os.PathLike[str], config: DatasetConfig) -> DatasetSummary:
    """Writes the files that describe a whole data set, once all views are rendered.

    ``transforms.json`` has the cameras and splits for nerfstudio, ``layers.json`` the meaning of the layers and the
    names of categories, ``contact_sheet.png`` the first views. ``shards`` has tar files for WebDataset if
    ``config.shard_views`` is above 0; otherwise existing shards are removed.

    Args:
        folder: Folder of the data set.
        config: Its settings.

    Returns:
        The number of views in each split. If ``missing`` is above 0, no file has been written.

    Raises:
        ConfigError: ``config`` is not a DatasetConfig.
        FormatError: A file cannot be read or written.
    """
    check_kind("config", config, DatasetConfig)
    root = Path(folder)
    records = [record for index in range(config.views) if (record := _read(root / view_file(index))) is not None]
    missing = config.views - len(records)
    shards: list[Path] = []
    if not missing:
        _write_sheet(root / "contact_sheet.png", root, records)
        if config.shard_views:
            shards = _write_shards(root, records, config.shard_views)
        else:
            _remove_shards(root, ())
        _write_json(root / "layers.json", _layers(config, records))
        _write_json(root / "transforms.json", _transforms(records))
    counts = {split: sum(record["split"] == split for record in records) for split in ("train", "val", "test")}
    left_out = sum(len(record["left_out"]) for record in records)
    return DatasetSummary(**counts, missing=missing, left_out=left_out, shards=tuple(shards))


def _read(path: Path) -> dict[str, Any] | None:
    """Returns the content of a view's JSON file; None if there is no file, because the view is not rendered yet.

    Raises:
        FormatError: The file is damaged.
    """
    try:
        return cast(dict[str, Any], json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise FormatError(path, f"cannot be read: {error}") from None


def _transforms(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the cameras and splits in the format of nerfstudio's ``transforms.json``."""
    names: dict[str, list[str]] = {split: [] for split in ("train", "val", "test")}
    frames: list[dict[str, Any]] = []
    for record in records:
        camera, files = record["camera"], record["files"]
        names[record["split"]].append(files["color"])
        world_from_camera = np.linalg.inv(np.array(camera["camera_from_world"]))
        frame: dict[str, Any] = {
            "file_path": files["color"],
            "w": camera["width"],
            "h": camera["height"],
            "fl_x": camera["fx"],
            "fl_y": camera["fy"],
            "cx": camera["cx"],
            "cy": camera["cy"],
            "transform_matrix": (world_from_camera @ OPENGL_FROM_OPENCV).tolist(),
        }
        for layer, key in (("depth", "depth_file_path"), ("mask", "mask_path")):
            if layer in files:
                frame[key] = files[layer]
        frames.append(frame)
    splits = {f"{split}_filenames": listed for split, listed in names.items()}
    return {"camera_model": "OPENCV", "frames": frames, **splits}


def _layers(config: DatasetConfig, records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the content of ``layers.json``: the meaning of the layers, and the categories that occur in the views."""
    categories = {thing["category"]: thing["category_id"] for record in records for thing in record["things"]}
    return {
        "axes": _AXES,
        "layers": {layer: LAYER_FILES[layer]._asdict() for layer in ("color", *config.layers)},
        "categories": dict(sorted(categories.items(), key=lambda pair: pair[1])),
    }


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    with atomic_write(path) as temporary:
        Path(temporary).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


SHARD_FOLDER = "shards"


def _write_shards(folder: Path, records: Sequence[Mapping[str, Any]], views: int) -> list[Path]:
    """Writes the views of each split into shards ``train-000000.tar`` and so on; repeated calls write equal bytes.

    A view has the members ``view_000012.png``, ``view_000012.depth.npy`` and so on, ``view_000012.json`` last. Existing
    shards with higher numbers are removed.

    Args:
        folder: Folder of the data set.
        records: JSON records of the views, in order.
        views: Largest number of views per shard.

    Returns:
        Paths of the shards.

    Raises:
        FormatError: A file cannot be read or written.
    """
    shards: list[Path] = []
    for split in ("train", "val", "test"):
        chosen = [record for record in records if record["split"] == split]
        for number, first in enumerate(range(0, len(chosen), views)):
            path = folder / SHARD_FOLDER / f"{split}-{number:06d}.tar"
            with atomic_write(path) as temporary:
                _write_shard(temporary, folder, chosen[first : first + views])
            shards.append(path)
    _remove_shards(folder, shards)
    return shards


def _remove_shards(folder: Path, kept: Sequence[Path]) -> None:
    """Deletes all shard files (``.tar``) of a data set except those in ``kept``."""
    for path in (folder / SHARD_FOLDER).glob("*-??????.tar"):
        if path not in kept:
            with suppress(OSError):
                path.unlink()


def _write_shard(path: Path, folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Writes one shard as a tar file without modification times and owners."""
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for record in records:
            for member, file in _members(folder, record).items():
                with readable(file):
                    content = file.read_bytes()
                entry = tarfile.TarInfo(member)
                entry.size, entry.mode = len(content), 0o644
                tar.addfile(entry, io.BytesIO(content))


def _members(folder: Path, record: Mapping[str, Any]) -> dict[str, Path]:
    """Returns the files of a view by their names in a shard, such as ``view_000012.depth.npy``."""
    name, files = view_name(record["view"]), record["files"]
    members: dict[str, Path] = {}
    for layer, file in files.items():
        suffix = Path(file).suffix
        members[f"{name}{suffix}" if layer == "color" else f"{name}.{layer}{suffix}"] = folder / file
    members[f"{name}.json"] = folder / "views" / f"{name}.json"
    return members


_SHEET_TILES = 48
"""Largest number of images on the contact sheet; a view has one for each of its layers."""
_SHEET_COLUMNS = 8
"""Largest number of images in a row of the contact sheet. A row has one or more whole views, so a view with more
layers exceeds it."""
_TILE_WIDTH = 200
"""Width of an image on the contact sheet, pixels."""
_FAR, _NEAR = 0.1, 1.0
"""Grey values on the contact sheet, 0..1: `_FAR` for the farthest surface of a depth image, `_NEAR` for the nearest."""
_NOT_ON_SHEET = ("exr",)


def _write_sheet(path: Path, folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Writes a contact sheet of the first views: for each view, its colour image and layers side by side.

    Depth is shown as grey values, the nearest surface white. Each id is shown in a different colour.

    Args:
        path: The PNG file.
        folder: Folder of the data set.
        records: JSON records of the views, in order.

    Raises:
        FormatError: A file cannot be read or written.
    """
    from PIL import Image

    layers = [layer for layer in records[0]["files"] if layer not in _NOT_ON_SHEET]
    on_sheet = records[: max(1, _SHEET_TILES // len(layers))]
    size = records[0]["camera"]["width"], records[0]["camera"]["height"]
    width, height = _TILE_WIDTH, max(1, round(_TILE_WIDTH * size[1] / size[0]))
    views_per_row = max(1, _SHEET_COLUMNS // len(layers))
    rows = -(-len(on_sheet) // views_per_row)
    sheet = Image.new("RGB", (min(views_per_row, len(on_sheet)) * len(layers) * width, rows * height))
    for number, record in enumerate(on_sheet):
        left, top = number % views_per_row * len(layers) * width, number // views_per_row * height
        for column, layer in enumerate(layers):
            tile = _tile(folder / record["files"][layer], layer)
            resampling = Image.Resampling.NEAREST if layer in ("instance", "category") else Image.Resampling.BOX
            sheet.paste(tile.resize((width, height), resampling), (left + column * width, top))
    with atomic_write(path) as temporary:
        sheet.save(temporary, format="PNG")


def _tile(path: Path, layer: str) -> Image.Image:
    """Reads the file of a layer as an RGB image for the contact sheet."""
    from PIL import Image

    try:
        if layer == "depth":
            return Image.fromarray(_gray(np.load(path, allow_pickle=False)))
        with Image.open(path, formats=("PNG",)) as image:
            if layer in ("instance", "category"):
                return Image.fromarray(_colors(np.asarray(image)))
            if image.mode == "RGBA":
                return Image.alpha_composite(Image.new("RGBA", image.size, (90, 90, 90, 255)), image).convert("RGB")
            return image.convert("RGB")
    except (OSError, ValueError) as error:
        raise FormatError(path, f"cannot be read: {error}") from None


def _gray(depth: FloatArray) -> np.ndarray:
    """Returns depth as grey bytes, shape (H, W, 3): the nearest surface white, pixels without a surface black."""
    surface = depth > 0.0
    near, far = (depth[surface].min(), depth[surface].max()) if surface.any() else (0.0, 1.0)
    nearness = (far - depth) / max(float(far - near), 1e-9)
    gray = np.where(surface, _FAR + (_NEAR - _FAR) * nearness, 0.0)
    return np.repeat((255.0 * np.clip(gray, 0.0, 1.0)).astype(np.uint8)[..., None], 3, axis=2)


def _colors(ids: np.ndarray) -> np.ndarray:
    """Returns a colour for each id, shape (H, W, 3); id 0 is black."""
    hashed = ids.astype(np.uint32) * np.uint32(2654435761)
    colors = np.stack([(hashed >> shift) & 0xFF for shift in (8, 16, 24)], axis=-1) / 255.0
    return (255.0 * np.where(ids[..., None] > 0, 0.25 + 0.75 * colors, 0.0)).astype(np.uint8)
