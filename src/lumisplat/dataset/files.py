"""Writes the files of a view: colour image, layers, and camera, lights and labels as JSON."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config import DatasetConfig
from lumisplat.dataset.labels import DatasetThing, DatasetView, id_images
from lumisplat.errors import ConfigError, SceneError
from lumisplat.frame.frame import Frame
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.images.texture import write_gray_png, write_png
from lumisplat.math.arrays import FloatArray
from lumisplat.math.color import encode_srgb
from lumisplat.scene.lights import Light


class LayerFiles(NamedTuple):
    """Where the files of a layer are and what they mean: folder, extension, and one line for ``layers.json``."""

    folder: str
    extension: str
    meaning: str


LAYER_FILES = {
    "color": LayerFiles("images", "png", "8-bit sRGB, exposed and tone-mapped; straight alpha if it is transparent"),
    "depth": LayerFiles(
        "depth", "npy", "float32 (height, width): distance along the camera's z axis, scene units; 0: no surface"
    ),
    "normal": LayerFiles(
        "normal",
        "png",
        "8-bit: 127.5 (1 + normal), in the camera's axes, x right, y down, z forward; 0 0 0: no surface",
    ),
    "albedo": LayerFiles("albedo", "png", "8-bit sRGB: reflectance of surfaces, without light"),
    "alpha": LayerFiles("alpha", "png", "8-bit grey: share of the pixel that is covered, 0 to 255"),
    "mask": LayerFiles("mask", "png", "8-bit grey: 255 where at least half of the pixel is covered, else 0"),
    "instance": LayerFiles(
        "instance", "png", "grey, 8-bit, or 16-bit of more than 255 things: the id of the thing; 0: none"
    ),
    "category": LayerFiles(
        "category", "png", "grey, 8-bit, or 16-bit of more than 255 categories: the id of the category; 0: none"
    ),
    "exr": LayerFiles(
        "exr",
        "exr",
        "32-bit: linear Rec.709 R G B A, neither exposed nor tone-mapped; depth.Z along rays, normals in world axes",
    ),
}
"""Folder, extension and meaning of every layer's files, by the name of the layer, such as ``depth``."""

VIEW_FOLDER = "views"


def view_name(index: int) -> str:
    """Returns the name, without extension, that all files of a view have."""
    return f"view_{index:06d}"


def view_file(index: int) -> str:
    """Returns the path of a view's JSON file, relative to the data set's folder.

    The JSON file is written last and marks the view as complete.
    """
    return f"{VIEW_FOLDER}/{view_name(index)}.json"


def layer_file(layer: str, name: str) -> str:
    """Returns the path of a layer's file for the view ``name``, such as ``depth/view_000000.npy`` in the data set."""
    files = LAYER_FILES[layer]
    return f"{files.folder}/{name}.{files.extension}"


IdTypes = Mapping[str, type[np.uint8] | type[np.uint16]]
"""Pixel type, uint8 or uint16, of the layers ``instance`` and ``category``, by layer."""


def write_view(folder: Path, view: DatasetView, frame: Frame, config: DatasetConfig, id_types: IdTypes) -> None:
    """Writes all files of a view atomically, the JSON file last.

    Args:
        folder: Folder of the data set.
        view: The view.
        frame: Its rendered frame.
        config: Settings of the data set.
        id_types: Pixel types of the ``instance`` and ``category`` layers, equal for all views.

    Raises:
        ConfigError: The layers include ``albedo``, and the frame has none.
        FormatError: A file cannot be written.
    """
    ids, categories = id_images(frame.instance_index, view.things)
    for layer in config.layers:
        path = folder / layer_file(layer, view.name)
        if layer in id_types:
            image = ids if layer == "instance" else categories
            write_gray_png(path, image.astype(np.uint8) if id_types[layer] is np.uint8 else image)
        else:
            _write_layer(path, layer, frame)
    frame.save(folder / layer_file("color", view.name))
    record = _record(view, ids, config)
    with atomic_write(folder / view_file(view.index)) as temporary:
        Path(temporary).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def _write_layer(path: Path, layer: str, frame: Frame) -> None:
    """Writes one layer of a view, such as depth or normals, from the rendered frame."""
    if layer == "depth":
        with atomic_write(path) as temporary, Path(temporary).open("wb") as file:
            np.save(file, depth_along_z(frame), allow_pickle=False)
    elif layer == "normal":
        write_png(path, normals_as_bytes(frame))
    elif layer == "albedo":
        if frame.albedo is None:
            raise ConfigError("layers has 'albedo', which unlit views do not have: add lights, or remove the layer")
        write_png(path, np.clip(encode_srgb(np.clip(frame.albedo, 0.0, 1.0)), 0.0, 1.0))
    elif layer == "alpha":
        write_gray_png(path, (255.0 * np.clip(frame.alpha, 0.0, 1.0) + 0.5).astype(np.uint8))
    elif layer == "mask":
        write_gray_png(path, np.where(frame.alpha >= 0.5, 255, 0).astype(np.uint8))
    else:
        aovs = ("depth", "normal", *(("albedo",) if frame.albedo is not None else ()))
        frame.save(path, aovs)


def depth_along_z(frame: Frame) -> FloatArray:
    """Returns the depth of each pixel's surface along the camera's z axis, shape (H, W); 0 without a surface."""
    depth = frame.depth_z
    return np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)


def normals_as_bytes(frame: Frame) -> npt.NDArray[np.uint8]:
    """Returns the normals in camera axes as bytes, 127.5 (1 + normal), shape (H, W, 3); 0 0 0 without a surface."""
    # Not BLAS: its last bits depend on the number of threads.
    normal = np.einsum("hwi,ji->hwj", frame.normal.astype(np.float64), frame.camera.camera_from_world[:3, :3])
    levels = np.clip(127.5 * (1.0 + normal) + 0.5, 0.0, 255.0)
    has_surface = np.isfinite(frame.depth) & frame.normal.any(axis=2)
    return np.where(has_surface[..., None], levels, 0.0).astype(np.uint8)


def _record(view: DatasetView, ids: npt.NDArray[np.uint16], config: DatasetConfig) -> dict[str, Any]:
    """Returns the content of a view's JSON file: camera, lights, labels, split and file names.

    ``ids`` is the image of object ids, shape (H, W).
    """
    camera = view.camera
    return {
        "view": view.index,
        "name": view.name,
        "split": view.split,
        "seed": config.seed,
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "near": camera.near,
            "exposure": camera.exposure,
            "camera_from_world": camera.camera_from_world.tolist(),
        },
        "lights": [_light_record(light) for light in view.scene.lights],
        "things": [_object_record(thing, ids) for thing in view.things],
        "left_out": list(view.left_out),
        "files": {layer: layer_file(layer, view.name) for layer in ("color", *config.layers)},
    }


def _object_record(thing: DatasetThing, ids: npt.NDArray[np.uint16]) -> dict[str, Any]:
    """Returns the JSON entry of an object, with the bounding box of its visible pixels.

    ``ids`` is the image of object ids, shape (H, W).
    """
    rows, columns = np.nonzero(ids == thing.id)
    box = None
    if rows.size:
        left, top = int(columns.min()), int(rows.min())
        box = [left, top, int(columns.max()) - left + 1, int(rows.max()) - top + 1]
    return {
        "id": thing.id,
        "name": thing.name,
        "category": thing.category,
        "category_id": thing.category_id,
        "kind": thing.kind,
        "is_object": thing.is_object,
        "world_from_object": thing.world_from_object.tolist(),
        "box_low": thing.low.tolist(),
        "box_high": thing.high.tolist(),
        "visible_pixels": int(rows.size),
        "bbox": box,
    }


def _light_record(light: Light) -> dict[str, Any]:
    """Returns the JSON entry of a light: its class and its fields, except the image of an environment."""
    values = {
        field.name: getattr(light, field.name)
        for field in dataclasses.fields(light)
        if field.name not in ("image", "enabled", "casts_shadow")
    }
    return {"type": type(light).__name__, **{name: _json_value(value) for name, value in values.items()}}


def _json_value(value: object) -> object:
    """Converts a field's value to JSON types; an infinite number becomes null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, tuple | list | np.ndarray):
        return [_json_value(one) for one in np.asarray(value, dtype=np.float64).tolist()]
    return value


def id_type(count: int) -> type[np.uint8] | type[np.uint16]:
    """Returns the smallest pixel type of an image that stores ids up to ``count``.

    Raises:
        SceneError: There are more than 65,535 ids.
    """
    if count > np.iinfo(np.uint16).max:
        raise SceneError(f"there are {count:,} objects, and id images hold at most 65,535: merge some")
    return np.uint8 if count <= np.iinfo(np.uint8).max else np.uint16
