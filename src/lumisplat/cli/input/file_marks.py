"""The files that a scene file refers to, and marks that show whether one has changed: its size and its time."""

from __future__ import annotations

import codecs
import importlib
import json
import os
import re
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

_OF_OBJ = re.compile(r"^(?:mtllib|map_\w+|norm|bump)\s+(?:.*\s)?(\S+)\s*$", re.MULTILINE)
_OF_USDA = re.compile(r"@([^@\n]+)@")
_OBJ_HEAD = 2**20
"""Bytes of an OBJ that are searched for its material library."""


def file_marks(paths: list[Path], apart: Path) -> dict[str, str]:
    """Size and time of files and of all files that they refer to, by their paths from the first one's folder.

    A text in a file refers to a file if it is its path from the folder of the file that holds the text; the path of a
    folder refers to the files in it.

    Args:
        paths: The files to begin with; the first is the scene file.
        apart: A folder that is left out, that of the frames.
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
        if not path.is_file():
            continue
        status = path.stat()
        found[path] = f"{status.st_size} bytes, {status.st_mtime_ns} ns"
        with suppress(ValueError):  # a file that does not parse refers to nothing here; its reader reports it
            waiting += [path.parent / name for text in _texts(path) for name in _paths(text)]
    home = Path(os.path.abspath(paths[0])).parent
    return {os.path.relpath(path, home): mark for path, mark in sorted(found.items())}


def toml_values(path: Path) -> dict[str, Any]:
    """Parses a TOML file, in UTF-8 or UTF-16, with or without a byte order mark.

    Raises:
        OSError: It cannot be read.
        ValueError: It is not TOML.
    """
    data = path.read_bytes()
    is_utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return tomllib.loads(data.decode("utf-16" if is_utf16 else "utf-8-sig"))


def _paths(text: str) -> set[str]:
    """The paths that a text may be, with slashes or Windows' backslashes; none for this folder and those around it."""
    is_path = 0 < len(text) < 1024 and "\0" not in text and bool(set(Path(text).parts) - {".", "..", "/"})
    return {text, text.replace("\\", "/")} if is_path else set()


def _texts(path: Path) -> Iterator[str]:
    """The texts of a file that may refer to others."""
    suffix = path.suffix.lower()
    if suffix == ".toml":
        yield from _strings(toml_values(path))
    elif path.name in ("meta.json", "lod-meta.json"):
        yield from _strings(json.loads(path.read_bytes()))
    elif suffix in (".gltf", ".glb"):
        for text in _strings(gltf_document(path)):
            yield from {text, unquote(text)}
    elif suffix in (".usda", ".usd", ".usdc"):
        with path.open("rb") as stream:
            is_binary = stream.read(8) == b"PXR-USDC"
        yield from _of_usd(path) if is_binary else _OF_USDA.findall(path.read_text(errors="replace"))
    elif suffix in (".obj", ".mtl"):
        with path.open("rb") as stream:
            yield from _OF_OBJ.findall(stream.read(_OBJ_HEAD).decode(errors="replace"))


def gltf_document(path: Path) -> Any:
    """Reads the JSON of a .gltf or a .glb, without its buffers; None if a .glb does not begin with it."""
    if path.suffix.lower() == ".gltf":
        return json.loads(path.read_bytes())
    with path.open("rb") as stream:
        head = stream.read(20)
        return json.loads(stream.read(int.from_bytes(head[12:16], "little"))) if head[16:20] == b"JSON" else None


def _of_usd(path: Path) -> list[str]:
    """The files that a binary layer of OpenUSD refers to: layers, and the values of all attributes and times."""
    try:
        library: Any = importlib.import_module("pxr.UsdUtils")
    except ImportError:  # then nothing reads it
        return []
    return [text for texts in library.ExtractExternalReferences(str(path)) for text in texts]


def _strings(value: object) -> Iterator[str]:
    """All texts in the values of a document."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in cast(dict[str, object], value).values():
            yield from _strings(inner)
    elif isinstance(value, list):
        for inner in cast(list[object], value):
            yield from _strings(inner)
