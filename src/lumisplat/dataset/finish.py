"""What a data set has beside its views: cameras for all of them, tables of ids and layers, a sheet, shards."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from lumisplat.config.checks import check_kind
from lumisplat.config.dataset import DatasetConfig
from lumisplat.dataset.files import LAYER_FILES, view_file
from lumisplat.dataset.shards import remove_shards, write_shards
from lumisplat.dataset.sheet import write_sheet
from lumisplat.errors import FormatError
from lumisplat.io.cameras.json_cameras import OPENGL_FROM_OPENCV
from lumisplat.io.files.atomic import atomic_write

_AXES = "cameras: x right, y down, z forward (OpenCV); camera_from_world takes column vectors; lengths in scene units"


@dataclass(frozen=True, kw_only=True)
class DatasetSummary:
    """What there is of a data set."""

    train: int
    """Views to train by."""
    val: int
    """Views to validate by."""
    test: int
    """Views to test by."""
    missing: int
    """Views that are not there yet; unless it is 0, nothing was written."""
    left_out: int
    """Objects that found no room."""
    shards: tuple[Path, ...] = ()


def finish_dataset(folder: str | os.PathLike[str], config: DatasetConfig) -> DatasetSummary:
    """Writes what a data set has beside its views, once all are there.

    ``transforms.json``: cameras for nerfstudio, and which views are for what. ``layers.json``: what files hold, and the
    names of categories. ``contact_sheet.png``: the first views. ``shards``: tar files for WebDataset, if
    ``config.shard_views`` asks for them; else those that are there are removed.

    Args:
        folder: Of the data set.
        config: Its settings.

    Returns:
        What there is; with views ``missing``, nothing has been written.

    Raises:
        ConfigError: ``config`` is no DatasetConfig.
        FormatError: A file cannot be read or written.
    """
    check_kind("config", config, DatasetConfig)
    place = Path(folder)
    records = [record for index in range(config.views) if (record := _read(place / view_file(index))) is not None]
    missing = config.views - len(records)
    shards: list[Path] = []
    if not missing:
        write_sheet(place / "contact_sheet.png", place, records)
        if config.shard_views:
            shards = write_shards(place, records, config.shard_views)
        else:
            remove_shards(place, ())
        _write_json(place / "layers.json", _layers(config, records))
        _write_json(place / "transforms.json", _transforms(records))
    counts = {split: sum(record["split"] == split for record in records) for split in ("train", "val", "test")}
    left_out = sum(len(record["left_out"]) for record in records)
    return DatasetSummary(**counts, missing=missing, left_out=left_out, shards=tuple(shards))


def _read(path: Path) -> dict[str, Any] | None:
    """What is known of a view; None: the view is not there.

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
    """Cameras as nerfstudio has them."""
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
    """What files hold, and the categories that views have."""
    categories = {thing["category"]: thing["category_id"] for record in records for thing in record["things"]}
    return {
        "axes": _AXES,
        "layers": {layer: LAYER_FILES[layer]._asdict() for layer in ("color", *config.layers)},
        "categories": dict(sorted(categories.items(), key=lambda pair: pair[1])),
    }


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    with atomic_write(path) as temporary:
        Path(temporary).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
