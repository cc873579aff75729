"""Builds glTF documents by hand, for the tests of their reader."""

from __future__ import annotations

import base64
import json
import struct

import numpy as np


class Gltf:
    """Builds a glTF document whose arrays become accessors of one buffer."""

    def __init__(self) -> None:
        self.json: dict = {
            "asset": {"version": "2.0"},
            "buffers": [],
            "bufferViews": [],
            "accessors": [],
            "meshes": [],
            "nodes": [],
        }
        self.data = b""

    def view(self, data: bytes, **keys: int) -> int:
        """Appends bytes, 4-aligned, as a buffer view; returns its index."""
        self.data = self.data.ljust(-(-len(self.data) // 4) * 4, b"\0")
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **keys})
        self.data += data
        return len(self.json["bufferViews"]) - 1

    def accessor(self, array: np.ndarray, **keys: object) -> int:
        """Appends an accessor of an array, (N,), (N, 2..4) or (N, 4, 4) row-major matrices; returns its index."""
        component = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}[array.dtype.str[1:]]
        kind = "MAT4" if array.ndim == 3 else "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        stored = array.transpose(0, 2, 1) if array.ndim == 3 else array
        entry = {"bufferView": self.view(stored.tobytes()), "componentType": component, "count": len(array)}
        self.json["accessors"].append({**entry, "type": kind, **keys})
        return len(self.json["accessors"]) - 1

    def add(self, collection: str, **item: object) -> int:
        """Appends an item to a collection; returns its index."""
        self.json.setdefault(collection, []).append(item)
        return len(self.json[collection]) - 1

    def glb(self) -> bytes:
        """Returns the document as GLB."""
        self.json["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.json).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + b"\0" * (-len(self.data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def gltf(self, uri: str | None = None) -> bytes:
        """Returns the document as JSON, with the buffer at ``uri`` or embedded."""
        uri = uri or "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        self.json["buffers"] = [{"byteLength": len(self.data), "uri": uri}]
        return json.dumps(self.json).encode()
