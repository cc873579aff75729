"""Files of cameras, of any kind: which reader takes which."""

from __future__ import annotations

import os
from pathlib import Path

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.cameras.camera_json import read_camera_json, read_path_rate
from lumisplat.io.cameras.colmap import is_colmap, read_colmap
from lumisplat.io.cameras.names import unique_names
from lumisplat.io.files.source import PathLike
from lumisplat.io.formats import USD
from lumisplat.scene.animation.camera_path import CameraPath
from lumisplat.scene.camera import Camera


def read_cameras(path: PathLike, width: int | None = None, height: int | None = None) -> list[Camera]:
    """As `lumisplat.io.load_cameras`."""
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
    from lumisplat.io.photographs.loading import find_model

    file = next((file for file in (path / "transforms.json", path / "cameras.json") if file.is_file()), None)
    return file or find_model(path) or path


def _read_listed(path: Path, /, *, width: int | None, height: int | None) -> list[Camera]:
    """The cameras of a file that a scene file lists."""
    return read_cameras(path, width, height)


def read_camera_way(path: PathLike, width: int | None = None, height: int | None = None) -> CameraPath:
    """As `lumisplat.io.load_camera_path`."""
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
