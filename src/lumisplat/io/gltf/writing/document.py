"""A glTF file that is being made: its JSON, and the bytes of its one buffer."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike

VERTICES, TRIANGLES = 34962, 34963
"""What a buffer view is for, by the numbers of OpenGL: attributes of vertices, indices."""

_COMPONENT_TYPES = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_GLB_MAX = 2**32 - 1
"""Largest size of a GLB file, whose header has 32 bits for it."""


class GltfDocument:
    """Collects items; the buffer is written from the arrays themselves, without a copy of it in memory."""

    def __init__(self) -> None:
        self._json: dict[str, Any] = {"asset": {"version": "2.0", "generator": "lumisplat"}}
        self._parts: list[memoryview | bytes] = []
        self._size = 0

    def add(self, collection: str, item: dict[str, Any]) -> int:
        """Appends an item to ``"nodes"``, ``"meshes"``, ...; returns its index."""
        items: list[dict[str, Any]] = self._json.setdefault(collection, [])
        items.append(item)
        return len(items) - 1

    def count(self, collection: str) -> int:
        """How many items of a collection there are."""
        return len(self._json.get(collection, ()))

    def use(self, extension: str, **values: Any) -> dict[str, Any]:
        """The value of ``extensions`` of an item that has one extension, which the file then says that it uses."""
        used: list[str] = self._json.setdefault("extensionsUsed", [])
        if extension not in used:
            used.append(extension)
        return {extension: values}

    def add_light(self, light: dict[str, Any]) -> int:
        """Appends a light of KHR_lights_punctual; returns its index."""
        self.use("KHR_lights_punctual")
        lights = self._json.setdefault("extensions", {}).setdefault("KHR_lights_punctual", {"lights": []})["lights"]
        lights.append(light)
        return len(lights) - 1

    def accessor(
        self, values: npt.NDArray[Any], target: int = VERTICES, *, normalized: bool = False, bounds: bool = False
    ) -> int:
        """Appends an array, shape (N,) or (N, 1..4), of float32 or unsigned integers; returns the accessor's index.

        Args:
            values: Rows of a multiple of four bytes; those of indices may be shorter.
            target: What it is for.
            normalized: Whether integers stand for 0..1.
            bounds: Whether the file says the smallest and largest values, as it must of positions.
        """
        stored = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"), copy=False)
        rows = stored.reshape(len(stored), -1)
        item: dict[str, Any] = {
            "bufferView": self.view(rows.view(np.uint8).reshape(-1).data, target),
            "componentType": _COMPONENT_TYPES[stored.dtype.str[1:]],
            "count": len(rows),
            "type": _KINDS[rows.shape[1]],
        }
        if normalized:
            item["normalized"] = True
        if bounds:
            item |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self.add("accessors", item)

    def view(self, data: memoryview | bytes, target: int | None = None) -> int:
        """Appends bytes to the buffer; returns the index of their view."""
        item = {"buffer": 0, "byteOffset": self._size, "byteLength": len(data)}
        padding = bytes(-len(data) % 4)
        self._parts += [data, padding]
        self._size += len(data) + len(padding)
        return self.add("bufferViews", item | ({} if target is None else {"target": target}))

    def save(self, path: PathLike, nodes: list[int]) -> None:
        """Writes the file: a GLB, or, if its name ends with ``.gltf``, JSON that holds the buffer as text.

        Args:
            path: The file. It appears complete or not at all.
            nodes: Indices of the nodes at the top of its scene.

        Raises:
            FormatError: It would be too large, or cannot be written.
        """
        document = self._json | {"scene": 0, "scenes": [{"nodes": nodes}]}
        is_text = Path(path).suffix.lower() == ".gltf"
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            if is_text:
                self._write_text(file, document)
            else:
                self._write_glb(path, file, document)

    def _write_text(self, file: BinaryIO, document: dict[str, Any]) -> None:
        if self._parts:
            data = base64.b64encode(b"".join(map(bytes, self._parts))).decode()
            uri = f"data:application/octet-stream;base64,{data}"
            document |= {"buffers": [{"byteLength": self._size, "uri": uri}]}
        file.write(_encoded(document))

    def _write_glb(self, path: PathLike, file: BinaryIO, document: dict[str, Any]) -> None:
        if self._parts:
            document |= {"buffers": [{"byteLength": self._size}]}
        text = _encoded(document)
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + (8 + self._size if self._parts else 0)
        if length > _GLB_MAX:
            raise FormatError(path, f"would have {length:,} bytes, but GLB ends at {_GLB_MAX:,}: save it in parts")
        file.write(struct.pack("<4sII", b"glTF", 2, length))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        if self._parts:
            file.write(struct.pack("<I4s", self._size, b"BIN\0"))
            for part in self._parts:
                file.write(part)


def _encoded(document: dict[str, Any]) -> bytes:
    """The JSON as UTF-8. What is no text in the name of a file becomes a question mark."""
    return json.dumps(document, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode("utf-8", "replace")
