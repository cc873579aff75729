"""Up as a capture's file states it, found without reading its Gaussians where its format allows that."""

from __future__ import annotations

import json
import logging
import threading
import zipfile
from collections.abc import Generator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from lumisplat.errors import LumisplatError
from lumisplat.io.files.source import BLOCKS, STREAMED_SOG, format_of, parsing, read_bytes
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.gltf.extras import own_extras
from lumisplat.io.gltf.scene import read_gltf
from lumisplat.io.ply import read_ply_header
from lumisplat.io.splats.orientation import orientation_of, orientation_of_comments
from lumisplat.io.splats.sog import OURS, read_meta
from lumisplat.io.splats.spz import read_spz_orientation
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene
from lumisplat.scene.up import Vector

_log = logging.getLogger("lumisplat")

_USD = (".usd", ".usda", ".usdc", ".usdz")


def stated_up(path: Path) -> Vector | None:
    """Returns the unit vector that points up in a capture, in its own coordinates.

    Args:
        path: A file or folder of any format.

    Returns:
        None if the file states no up, is no capture, or cannot be read, which whoever reads it will say.
    """
    try:
        with parsing(path, "a capture"):
            kind = format_of(path)
            if kind in (".glb", ".gltf", *_USD):
                status = path.stat()
                return _up_by_format(path, kind, status.st_mtime_ns, status.st_size)
            return _up_by_values(path, kind)
    except (LumisplatError, OSError, zipfile.BadZipFile):
        return None


def _up_by_values(path: Path, kind: str) -> Vector | None:
    """Returns what is stated beside the Gaussians of a file."""
    if kind == ".ply":
        return orientation_of_comments(path, read_ply_header(path).comments).up
    if kind in (BLOCKS, STREAMED_SOG):
        stored = json.loads(read_bytes(path / kind if path.is_dir() else path))
        return orientation_of(path, stored if kind == BLOCKS else stored.get(OURS)).up
    if kind == ".sog":
        return orientation_of(path, read_meta(path).get(OURS)).up
    return read_spz_orientation(path).up if kind == ".spz" else None


@lru_cache(maxsize=64)
def _up_by_format(path: Path, kind: str, *_version: int) -> Vector | None:
    """Returns the up of a capture whose format says how it stands; only the place of its node tells that.

    The whole file is read for it, once for each of its versions, and without log lines: who loads it logs them.
    """
    with _silenced():
        if kind in _USD:
            from lumisplat.io.usd.scene import read_usd

            return _up_of(read_usd(path, drop_invalid=True))
        return _up_of(read_gltf(path, drop_invalid=True)) if _has_up(GltfFile(path)) else None


@contextmanager
def _silenced() -> Generator[None]:
    """Drops the log lines of this thread."""
    thread = threading.get_ident()

    def is_of_others(record: logging.LogRecord) -> bool:
        return record.thread != thread

    _log.addFilter(is_of_others)
    try:
        yield
    finally:
        _log.removeFilter(is_of_others)


def _up_of(loaded: Gaussians | Scene) -> Vector | None:
    return loaded.up if isinstance(loaded, Gaussians) else None


def _has_up(file: GltfFile) -> bool:
    """Whether a capture of a glTF file has an up of its own, besides that of the format."""
    primitives = (one for mesh in file.model.meshes or [] for one in mesh.primitives)
    return any("up" in (own_extras(one) or {}) for one in primitives)
