"""The format of a file: its extension, or what a folder holds."""

from __future__ import annotations

from pathlib import Path

from lumisplat.errors import FormatError
from lumisplat.io.files.source import check_regular

_INNER_LISTED = 8
"""How many captures of a folder a message lists."""


def format_of(path: Path) -> str:
    """The extension of a file that exists, ``.sog`` for a SOG folder or its meta.json."""
    if path.is_dir():
        if (path / "meta.json").is_file():
            return ".sog"
        raise FormatError(path, f"is a folder without a meta.json, expected a SOG folder or a file{_inner_sog(path)}")
    if not path.exists():
        raise FormatError(path, "no such file")
    check_regular(path, path.stat())
    if path.stat().st_size == 0:
        raise FormatError(path, "is empty: zero bytes")
    return ".sog" if path.name == "meta.json" else path.suffix.lower()


def _inner_sog(folder: Path) -> str:
    """Which folders in a folder are SOG captures, such as the levels of a streamed one, as the end of a message."""
    inner = sorted(meta.parent.name for meta in folder.glob("*/meta.json"))
    if not inner:
        return ""
    more = f" and {len(inner) - _INNER_LISTED} more" if len(inner) > _INNER_LISTED else ""
    return f": give one of the captures in it, {', '.join(inner[:_INNER_LISTED])}{more}"
