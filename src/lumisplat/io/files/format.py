"""The format of a file: its extension, or what a folder holds."""

from __future__ import annotations

from pathlib import Path

from lumisplat.errors import FormatError, MissingFileError
from lumisplat.io.files.source import check_regular

STREAMED_SOG = "lod-meta.json"
"""The file of a streamed SOG that lists its levels and chunks."""
BLOCKS = "blocks.json"
"""The file of a capture in blocks that lists them."""
_IMAGES = ("transforms.json", "transforms_train.json", "images", "sparse")
"""What folders of images hold that captures are trained from."""
_INNER_LISTED = 8
"""How many captures of a folder a message lists."""


def format_of(path: Path) -> str:
    """The extension of a file that exists; ``.sog`` for a SOG folder or its meta.json, `STREAMED_SOG` or `BLOCKS`."""
    if path.is_dir():
        if (path / "meta.json").is_file():
            return ".sog"
        if (path / STREAMED_SOG).is_file():
            return STREAMED_SOG
        if (path / BLOCKS).is_file():
            return BLOCKS
        if any((path / name).exists() for name in _IMAGES):
            raise FormatError(path, "is a folder of images, not a capture: lumisplat train makes a capture of them")
        given = f": give one of the captures in it, {inner}" if (inner := _inner_sog(path)) else ""
        raise FormatError(path, f"is a folder without a meta.json, expected a SOG folder or a file{given}")
    if not path.exists():
        raise MissingFileError(path, "no such file")
    check_regular(path, path.stat())
    if path.stat().st_size == 0:
        raise FormatError(path, "is empty: zero bytes")
    if path.name in (STREAMED_SOG, BLOCKS):
        return path.name
    return ".sog" if path.name == "meta.json" else path.suffix.lower()


def _inner_sog(folder: Path) -> str:
    """The SOG captures in a folder, by their paths from there: the first few, and how many more there are."""
    inner = sorted(str(meta.relative_to(folder)) for meta in (*folder.glob("*/meta.json"), *folder.glob("*.sog")))
    more = f" and {len(inner) - _INNER_LISTED} more" if len(inner) > _INNER_LISTED else ""
    return ", ".join(inner[:_INNER_LISTED]) + more
