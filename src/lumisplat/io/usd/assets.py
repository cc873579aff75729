"""Files that a stage names besides its layers: textures and skies, beside it or in its package."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import Any

from lumisplat.constants import FILE_BYTES_MAX
from lumisplat.errors import FormatError
from lumisplat.io.files.references import read_reference, referenced_file
from lumisplat.io.files.source import check_regular
from lumisplat.io.usd.library import pxr
from lumisplat.io.usd.process import allow_asset
from lumisplat.io.usd.stage import UsdFile


def asset_name(asset: Any) -> str:
    """The path of an asset, as the layer has it."""
    return str(getattr(asset, "path", asset))


def asset_bytes(file: UsdFile, asset: Any, label: str) -> bytes:
    """The contents of a file that a value names, to be decoded.

    Args:
        file: The open file.
        asset: A path of the library, which knows what it was resolved to.
        label: What names it, for messages.

    Raises:
        FormatError: There is no such file, it leaves the folder of the stage, or it cannot be read.
    """
    data = _stored_bytes(file, asset, label)
    allow_asset(len(data))
    return data


def _stored_bytes(file: UsdFile, asset: Any, label: str) -> bytes:
    """As `asset_bytes`."""
    ar, name = pxr().Ar, asset_name(asset)
    found = str(getattr(asset, "resolvedPath", "")) or name
    if found == name and file.path.suffix.lower() == ".usdz":  # not found by the library: perhaps it is there
        found = ar.JoinPackageRelativePath([os.fspath(file.path), os.path.normpath(name)])
    if not ar.IsPackageRelativePath(found):
        return read_reference(file.path, found)
    package, inner = ar.SplitPackageRelativePathOuter(found)
    place = referenced_file(file.path, package)
    try:
        check_regular(place, place.stat())
        # A package in a package is not unpacked: USD advises against them.
        with zipfile.ZipFile(place) as held:
            entry = held.getinfo(inner)
            if entry.file_size > FILE_BYTES_MAX or entry.compress_type != zipfile.ZIP_STORED:
                raise FormatError(file.path, f"{label} names {name[:200]!r}, which is packed or too large")
            return held.read(entry)
    except FormatError:
        raise
    except (KeyError, OSError, zipfile.BadZipFile):
        raise FormatError(file.path, f"{label} names {name[:200]!r}, which {Path(package).name} lacks") from None
