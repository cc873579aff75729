"""Reads and writes files by their formats: tables of what reads and writes each extension.

Functions are named, ``splats.spz.read_spz``, and their modules imported when a format is first used. Headers tell
whether a PLY is a capture, compressed or not, or a mesh.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from lumisplat.errors import ConfigError, FormatError, SceneError
from lumisplat.io.files.source import BLOCKS, STREAMED_SOG, PathLike, format_of

if TYPE_CHECKING:
    import numpy.typing as npt

    from lumisplat.io.ply import PlyHeader
    from lumisplat.io.splats.columns import SplatColumns
    from lumisplat.scene.animation.actors import Animation
    from lumisplat.scene.animation.camera_path import CameraPath
    from lumisplat.scene.camera import Camera
    from lumisplat.scene.gaussians import Gaussians
    from lumisplat.scene.mesh import Mesh
    from lumisplat.scene.scene import Scene

    Loaded = SplatColumns | Gaussians | Mesh | Scene


class LoadOptions(NamedTuple):
    """Options of `lumisplat.io.load` that some readers take."""

    drop_invalid: bool
    """Of glTF and OpenUSD files; `SplatColumns` are not checked yet."""
    crease_angle: float | None
    """Of OBJs."""
    up: str | npt.ArrayLike | None
    """Of scene files."""
    progress: Callable[[float], None] | None
    """Of PLYs."""
    incident: bool
    """Of PLYs."""
    lod: int | None
    """Of streamed SOGs and captures in blocks."""
    budget: int | None
    """Likewise: Gaussians."""


USD = (".usd", ".usda", ".usdc", ".usdz")
"""Extensions of OpenUSD."""

_READERS = {
    ".spz": "splats.spz.read_spz",
    ".splat": "splats.ksplat.read_splat",
    ".ksplat": "splats.ksplat.read_ksplat",
    ".sog": "splats.sog.read_sog",
    ".obj": "meshes.obj.read_obj",
    ".stl": "meshes.stl.read_stl",
    ".glb": "gltf.scene.read_gltf",
    ".gltf": "gltf.scene.read_gltf",
    **dict.fromkeys(USD, "usd.scene.read_usd"),
}
"""Besides these, .ply is read by its header, .toml by what it names, and streamed SOGs and blocks at a level."""

_LEVELED = {STREAMED_SOG: "splats.streamed_sog.read_streamed_sog", BLOCKS: "blocks.views.read_blocks"}
"""Readers of captures in levels of detail."""

_MOVING = {
    **dict.fromkeys((".glb", ".gltf"), "gltf.animation.read_gltf_animation"),
    **dict.fromkeys(USD, "usd.animation.read_usd_animation"),
}
"""Readers of animations, besides those of scene files."""

_OURS = "lumisplat"

_PLY_WRITERS = {_OURS: "splats.splat_ply.write_splat_ply", "r3dg": "splats.splat_ply.write_r3dg_ply"}
"""By whose columns they write."""

_WRITERS = {
    ".compressed.ply": "splats.compressed_ply.write_compressed_ply",
    ".ply": _PLY_WRITERS[_OURS],
    ".spz": "splats.spz.write_spz",
    ".sog": "splats.sog.write_sog",
    "/meta.json": "splats.sog.write_sog",
    f"/{STREAMED_SOG}": "splats.streamed_sog.write_streamed_sog",
}
"""Writers of captures; the first one that a path ends with is used."""

_SCENE_WRITERS = {
    ".glb": "gltf.scene.write_gltf",
    ".gltf": "gltf.scene.write_gltf",
    **dict.fromkeys(USD, "usd.writing.write_usd"),
}
"""Writers of scenes with their cameras, to which captures and meshes are scenes, too."""

READABLE = (
    ".ply, .compressed.ply, .spz, .splat, .ksplat, .sog, a SOG folder or its meta.json or lod-meta.json, a folder of "
    "blocks, .obj, .stl, .glb, .gltf, .usda, .usdc, .usdz, .usd, .toml"
)

WRITABLE = (
    ".ply, .compressed.ply, .spz, .sog, .glb, .gltf, .usda, .usdc, .usdz, .usd, or, in a "
    "folder, meta.json (SOG) or lod-meta.json (SOG in levels of detail)"
)


def read(path: Path, load: Callable[..., Gaussians | Mesh | Scene], options: LoadOptions) -> Loaded:
    """What is in a file; see `lumisplat.io.load`.

    Args:
        path: The file.
        load: Reads the files that a scene file names.
        options: How.

    Raises:
        FormatError: The file is unknown, or cannot be read.
    """
    extension = format_of(path)
    if extension == ".ply":
        return _read_ply(path, options.progress, incident=options.incident)
    if extension == ".toml":
        return _import("scene_toml.scene_file.read_scene_file")(path, load, options.up)
    if extension in _LEVELED:
        return _import(_LEVELED[extension])(path, options.lod, options.budget)
    if extension not in _READERS:
        raise FormatError(path, f"unknown extension {path.suffix!r}, expected {READABLE}")
    reader: Callable[..., Loaded] = _import(_READERS[extension])
    if extension in (".glb", ".gltf", *USD):
        return reader(path, drop_invalid=options.drop_invalid)
    if extension == ".obj" and options.crease_angle is not None:
        return reader(path, options.crease_angle)
    return reader(path)


def read_animation(
    path: Path,
    load: Callable[..., Gaussians | Mesh | Scene],
    load_cameras: Callable[..., list[Camera]],
    *,
    drop_invalid: bool,
) -> Animation:
    """What moves in a file; see `lumisplat.io.load_animation`.

    Args:
        path: A scene file, or one of `_MOVING`.
        load: Reads the files that a scene file names.
        load_cameras: Likewise.
        drop_invalid: Of the others.

    Raises:
        FormatError: It cannot be read.
    """
    reader = _MOVING.get(path.suffix.lower())
    if reader is not None:
        return _import(reader)(path, drop_invalid)
    return _import("scene_toml.scene_file.read_animation")(path, load, load_cameras)


def check_written(path: PathLike, *, scene: bool = False) -> str:
    """The function that writes a file, by its extension; see `lumisplat.io.check_format`.

    Raises:
        FormatError: The extension is unknown, or of captures alone.
    """
    name = f"/{Path(path).name.lower()}"
    if writer := next((_SCENE_WRITERS[end] for end in _SCENE_WRITERS if name.endswith(end)), None):
        return writer
    writer = next((_WRITERS[end] for end in _WRITERS if name.endswith(end)), None)
    if writer is None:
        expected = ", ".join(_SCENE_WRITERS) if scene else WRITABLE
        raise FormatError(path, f"unknown extension {Path(path).suffix!r}, expected {expected}")
    if scene:
        raise FormatError(path, f"holds Gaussians alone: scenes and meshes can be saved as {', '.join(_SCENE_WRITERS)}")
    return writer


def write(path: PathLike, asset: Gaussians | Mesh | Scene | Animation, cameras: Sequence[Camera], columns: str) -> None:
    """Writes a file in the format of its extension; see `lumisplat.io.save`.

    Args:
        path: The file.
        asset: What is written.
        cameras: Of a scene.
        columns: Whose columns a .ply has.

    Raises:
        ConfigError: ``path`` is no path, there are no such columns, or the file is no .ply.
        FormatError: The extension is unknown or cannot hold that, or the file cannot be written.
    """
    from lumisplat.scene.animation.actors import Animation
    from lumisplat.scene.gaussians import Gaussians
    from lumisplat.scene.mesh import Mesh
    from lumisplat.scene.scene import Scene

    if not isinstance(cast("object", path), str | os.PathLike):
        raise ConfigError(f"save(path, asset): the path comes first, got {type(path).__name__}")
    if not isinstance(cast("object", asset), Gaussians | Mesh | Scene | Animation):
        raise FormatError(
            path, f"only Gaussians, meshes, scenes and animations can be saved, got {type(asset).__name__}"
        )
    if isinstance(asset, Animation) and Path(path).suffix.lower() not in USD:
        raise FormatError(path, f"cannot hold what moves: animations can be saved as {', '.join(USD)}")
    writer = check_written(path, scene=bool(cameras) or not isinstance(asset, Gaussians))
    if columns not in _PLY_WRITERS:
        raise ConfigError(f"columns is {columns!r}, expected {' or '.join(map(repr, _PLY_WRITERS))}")
    if columns != _OURS:
        if writer != _PLY_WRITERS[_OURS]:
            raise ConfigError(f"columns {columns!r} are those of a .ply, got {os.fspath(path)}")
        writer = _PLY_WRITERS[columns]
    if writer not in _SCENE_WRITERS.values():
        _import(writer)(path, asset)
        return
    if isinstance(asset, Gaussians | Mesh):
        asset = Scene(splats=[asset]) if isinstance(asset, Gaussians) else Scene(meshes=[asset])
    _import(writer)(path, asset, cameras)


def _import(function: str) -> Any:
    """A function of this package, imported on first use."""
    module, _, name = function.rpartition(".")
    return getattr(import_module(f"{__package__}.{module}"), name)


def _read_ply(path: Path, progress: Callable[[float], None] | None, *, incident: bool) -> SplatColumns | Mesh:
    """Reads a capture or a mesh.

    Args:
        path: The file.
        progress: As of `lumisplat.io.load`.
        incident: As of `lumisplat.io.load`.
    """
    from lumisplat.io.ply import read_ply_header
    from lumisplat.io.splats.compressed_ply import is_compressed_header, read_compressed_ply
    from lumisplat.io.splats.splat_ply import read_splat_ply

    header = read_ply_header(path)
    if is_compressed_header(header):
        return read_compressed_ply(header)
    if _has_faces(header):
        from lumisplat.io.meshes.mesh_ply import read_ply_mesh

        return read_ply_mesh(header)
    return read_splat_ply(header, progress, incident=incident)


def holds_mesh(path: Path) -> bool:
    """Whether a file is a mesh, not a capture; False if it cannot be read.

    Args:
        path: A ``.ply`` file.
    """
    from lumisplat.io.ply import read_ply_header
    from lumisplat.io.splats.compressed_ply import is_compressed_header

    try:
        header = read_ply_header(path)
    except (OSError, FormatError):
        return False
    return not is_compressed_header(header) and _has_faces(header)


def _has_faces(header: PlyHeader) -> bool:
    """Whether there are faces or triangle strips, and no Gaussians."""
    from lumisplat.io.splats.splat_ply import is_gaussian_element

    vertex, surfaces = header.element("vertex"), map(header.element, ("face", "tristrips"))
    return any(one and one.count for one in surfaces) and not (vertex and is_gaussian_element(vertex))


def read_cameras(path: PathLike, width: int | None = None, height: int | None = None) -> list[Camera]:
    """As `lumisplat.io.load_cameras`."""
    from lumisplat.io.cameras.colmap import is_colmap, read_colmap
    from lumisplat.io.cameras.common import unique_names
    from lumisplat.io.cameras.json_cameras import read_camera_json

    path = _in_folder(Path(path))
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        from lumisplat.io.gltf.cameras import read_gltf_cameras

        return unique_names(read_gltf_cameras(path, width, height))
    if suffix in USD:
        from lumisplat.io.usd.cameras import read_usd_cameras

        return unique_names(read_usd_cameras(path, width, height))
    if suffix == ".toml":
        from lumisplat.io.scene_toml.cameras import read_scene_cameras
        from lumisplat.io.scene_toml.scene_file import read_document

        return read_scene_cameras(read_document(path), _read_listed, width, height)
    if is_colmap(path):
        return unique_names(read_colmap(path))
    return read_camera_json(path, width, height)


def _in_folder(path: Path) -> Path:
    """Returns the camera file that a folder of images holds; the path itself if it is a file, or holds none."""
    if not os.path.isdir(path):  # False, also of names that are too long
        return path
    from lumisplat.io.training_images.loading import find_model

    file = next((file for file in (path / "transforms.json", path / "cameras.json") if file.is_file()), None)
    return file or find_model(path) or path


def _read_listed(path: Path, /, *, width: int | None, height: int | None) -> list[Camera]:
    """The cameras of a file that a scene file lists."""
    return read_cameras(path, width, height)


def read_camera_way(path: PathLike, width: int | None = None, height: int | None = None) -> CameraPath:
    """As `lumisplat.io.load_camera_path`."""
    from lumisplat.io.cameras.json_cameras import read_path_rate
    from lumisplat.scene.animation.camera_path import CameraPath

    suffix, rate = Path(path).suffix.lower(), None
    if suffix == ".toml":
        from lumisplat.io.scene_toml.cameras import read_camera_path
        from lumisplat.io.scene_toml.scene_file import read_document

        moving = read_camera_path(read_document(path))
        if moving is not None:
            return moving
    elif suffix == ".json":
        rate = read_path_rate(path)
    cameras = read_cameras(path, width, height)
    if not cameras:
        raise FormatError(path, "has no cameras")
    try:
        return CameraPath(cameras, None if rate is None else [k / rate for k in range(len(cameras))])
    except SceneError as error:
        raise FormatError(path, str(error)) from None
