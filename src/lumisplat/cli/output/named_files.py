"""The files that a scene file is made of, and whether one has changed since: by size and time, not by content."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

_OF_OBJ = re.compile(r"^(?:mtllib|map_\w+|norm|bump)\s+(?:.*\s)?(\S+)\s*$", re.MULTILINE)
_OBJ_HEAD = 2**20
"""Bytes of an OBJ in which its material library is looked for."""


def file_marks(paths: list[Path], apart: Path) -> dict[str, str]:
    """Size and time of files and of all that they name, by their paths from the first one's folder.

    Text that is the path of a file, from the folder of what names it, counts as naming it; that of a folder names its
    files.

    Args:
        paths: What to begin with; the first is the scene file.
        apart: A folder that does not count, as the frames go there.
    """
    found: dict[Path, str] = {}
    waiting = list(paths)
    while waiting:
        path = Path(os.path.abspath(waiting.pop()))
        if path in found or path == Path(os.path.abspath(apart)) or not path.exists():
            continue
        if path.is_dir():
            waiting += [file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")]
            continue
        status = path.stat()
        found[path] = f"{status.st_size} bytes, {status.st_mtime_ns} ns"
        with suppress(ValueError):  # what does not parse names nothing; whoever reads it will say so
            waiting += [path.parent / text for text in _texts(path) if _may_be_a_path(text)]
    home = Path(os.path.abspath(paths[0])).parent
    return {os.path.relpath(path, home): mark for path, mark in sorted(found.items())}


def _may_be_a_path(text: str) -> bool:
    """Neither empty, nor this folder or one around it."""
    return 0 < len(text) < 1024 and "\0" not in text and bool(set(Path(text).parts) - {".", "..", "/"})


def _texts(path: Path) -> Iterator[str]:
    """The texts of a file that names others."""
    match path.suffix.lower():
        case ".toml":
            yield from _strings(tomllib.loads(path.read_text()))
        case ".gltf":
            yield from _strings(json.loads(path.read_text()))
        case ".obj" | ".mtl":
            with path.open("rb") as stream:
                yield from _OF_OBJ.findall(stream.read(_OBJ_HEAD).decode(errors="replace"))


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _strings(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _strings(inner)
