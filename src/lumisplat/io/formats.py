"""The tables of formats: what reads and writes files, by extension.

Functions are named, ``splats.spz.read_spz``, and their modules imported when a format is first used.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lumisplat.errors import ConfigError, FormatError
from lumisplat.io.files.format import format_of
from lumisplat.io.files.source import PathLike

if TYPE_CHECKING:
    import numpy.typing as npt

    from lumisplat.io.splats.columns import SplatColumns
    from lumisplat.scene.gaussians import Gaussians
    from lumisplat.scene.mesh import Mesh
    from lumisplat.scene.scene import Scene

_READERS = {
    ".spz": "splats.spz.read_spz",
    ".sog": "splats.sog.reader.read_sog",
    ".obj": "meshes.obj.read_obj",
    ".stl": "meshes.stl.read_stl",
    ".glb": "gltf.scene.read_gltf",
    ".gltf": "gltf.scene.read_gltf",
}
"""Besides these, .ply is read by its header, and .toml by what it names."""

_OURS = "lumisplat"
_PLY_WRITERS = {_OURS: "splats.splat_ply.write_splat_ply", "r3dg": "splats.r3dg_ply.write_r3dg_ply"}
"""By whose columns they write."""

_WRITERS = {
    ".compressed.ply": "splats.compressed_ply.write_compressed_ply",
    ".ply": _PLY_WRITERS[_OURS],
    ".spz": "splats.spz.write_spz",
    ".sog": "splats.sog.writer.write_sog",
    "/meta.json": "splats.sog.writer.write_sog",
}
"""Writers of captures; the first one that a path ends with is used."""

READABLE = ".ply, .compressed.ply, .spz, .sog, a SOG folder or its meta.json, .obj, .stl, .glb, .gltf, .toml"
WRITABLE = ".ply, .compressed.ply, .spz, .sog, or meta.json in a folder (SOG)"


def read(
    path: Path,
    load: Callable[..., Gaussians | Mesh | Scene],
    crease_angle: float | None,
    up: str | npt.ArrayLike | None,
    progress: Callable[[float], None] | None,
    *,
    incident: bool,
) -> SplatColumns | Mesh | Scene:
    """What is in a file; see `lumisplat.io.load`.

    Args:
        path: The file.
        load: Reads the files that a scene file names.
        crease_angle: Of OBJs.
        up: Of a scene file.
        progress: Called with the fraction done.
        incident: Whether to read incident light.

    Raises:
        FormatError: The file is unknown, or cannot be read.
    """
    extension = format_of(path)
    if extension == ".ply":
        return _import("ply_files.read_ply")(path, progress, incident=incident)
    if extension == ".toml":
        return _import("scene_toml.scene_file.read_scene_file")(path, load, up)
    if extension not in _READERS:
        raise FormatError(path, f"unknown extension {path.suffix!r}, expected {READABLE}")
    reader: Callable[..., SplatColumns | Mesh | Scene] = _import(_READERS[extension])
    return reader(path) if crease_angle is None or extension != ".obj" else reader(path, crease_angle)


def write(path: PathLike, gaussians: Gaussians, columns: str) -> None:
    """Writes a capture in the format of a file's extension; see `lumisplat.io.save`.

    Args:
        path: The file.
        gaussians: The capture.
        columns: Whose columns a .ply has.

    Raises:
        ConfigError: There are no such columns, or the file is no .ply.
        FormatError: The extension is unknown, or the file cannot be written.
    """
    ending = f"/{Path(path).name.lower()}"
    extension = next((end for end in _WRITERS if ending.endswith(end)), None)
    if extension is None:
        raise FormatError(path, f"unknown extension {Path(path).suffix!r}, expected {WRITABLE}")
    if columns not in _PLY_WRITERS:
        raise ConfigError(f"columns is {columns!r}, expected {' or '.join(map(repr, _PLY_WRITERS))}")
    if columns != _OURS and extension != ".ply":
        raise ConfigError(f"columns {columns!r} are those of a .ply, got {os.fspath(path)}")
    name = _PLY_WRITERS[columns] if extension == ".ply" else _WRITERS[extension]
    writer: Callable[[PathLike, Gaussians], None] = _import(name)
    writer(path, gaussians)


def _import(function: str) -> Any:
    """A function of this package, imported on first use."""
    module, _, name = function.rpartition(".")
    return getattr(import_module(f"{__package__}.{module}"), name)
