"""Reads and writes the glTF 2.0 container: GLB chunks, JSON, buffers and accessors.

`GltfFile` is a file being read, `GltfPrimitive` a primitive of its meshes, and `GltfDocument` a file being written.
"""

from __future__ import annotations

import base64
import json
import struct
import warnings
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeGuard, cast
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike, check_expansion, decode_text, read_bytes, read_reference

if TYPE_CHECKING:
    import pygltflib

    _RowSource = pygltflib.Accessor | pygltflib.AccessorSparseIndices | pygltflib.AccessorSparseValues

_Stored = npt.NDArray[Any]
"""Numbers of an accessor in its component type, such as uint16, before conversion to float32 or int64."""

_GLB_HEADER_BYTES = 12
_CHUNK_HEADER_BYTES = 8
_COMPONENT_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COMPONENT_COUNTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}

VERTICES, TRIANGLES = 34962, 34963
"""Values of ``target`` in buffer views: ARRAY_BUFFER for vertex attributes, ELEMENT_ARRAY_BUFFER for vertex indices."""

_COMPONENT_CODES = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_GLB_MAX = 2**32 - 1
"""Largest size of a GLB file in bytes; its header stores the size in 32 bits."""


class GltfFile:
    """A parsed glTF file. Its methods check each index and size from the file before they use it."""

    def __init__(self, path: Path) -> None:
        import pygltflib

        self.path = path
        data = read_bytes(path)
        self.stored_bytes = len(data)
        """Size in bytes of the file and of its external buffers read so far."""
        self._decoded_bytes = 0
        text, self._binary_chunk = _split_glb(path, data) if data[:4] == b"glTF" else (data, None)
        try:
            document: dict[str, Any] = json.loads(decode_text(text))
            self.extensions = _extensions(document)
            """Names of all extensions used in the file."""
            nodes: list[dict[str, Any]] | None = document.pop("nodes", None)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # warnings about missing values, which are checked here
                self.model: pygltflib.GLTF2 = pygltflib.GLTF2.gltf_from_json(json.dumps(document))
            # pygltflib takes a millisecond per node, and files have up to 100,000 nodes: build them directly.
            known = {field.name for field in fields(pygltflib.Node)}
            self.model.nodes = [
                pygltflib.Node(**{key: value for key, value in node.items() if key in known}) for node in nodes or []
            ]
        except json.JSONDecodeError as error:
            raise FormatError(path, f"the JSON is truncated or damaged at line {error.lineno}: {error.msg}") from None
        except UnicodeDecodeError:
            raise FormatError(path, "is neither GLB nor glTF: it has no GLB header and is not JSON text") from None
        version = str(getattr(self.model.asset, "version", ""))
        if not version.startswith("2."):
            raise FormatError(path, f"is glTF version {version or 'unknown'}, expected 2.0")
        self._buffers: dict[int, bytes] = {}

    def item(self, collection: str, index: object, referrer: str) -> Any:
        """Returns ``collection[index]``.

        Args:
            collection: ``"nodes"``, ``"meshes"``, ``"accessors"``, ...
            index: Index as stored in the file.
            referrer: The item that contains the index, for the message.

        Raises:
            FormatError: The collection has no such index.
        """
        items: list[Any] = getattr(self.model, collection) or []
        if not _is_count(index) or index >= len(items):
            raise FormatError(self.path, f"{referrer} refers to {collection}[{index}], but there are {len(items)}")
        return items[index]

    def floats(self, index: object, kind: str, referrer: str) -> npt.NDArray[np.float32]:
        """Reads an accessor as float32, shape (count, components); normalized integers become fractions.

        Args:
            index: Index of the accessor.
            kind: The expected type, such as ``"VEC3"``, or several separated by spaces, such as ``"VEC3 VEC4"``.
            referrer: The item that refers to the accessor, for the message.

        Raises:
            FormatError: The index, type, an offset or a size is invalid.
        """
        accessor = self.item("accessors", index, referrer)
        values = self._values(accessor, f"accessors[{index}]", kind)
        self._count(4 * values.size)
        if accessor.normalized and values.dtype.kind in "iu":
            return np.maximum(values / np.float32(np.iinfo(values.dtype).max), np.float32(-1.0)).astype(np.float32)
        return values.astype(np.float32)

    def integers(self, index: object, kind: str, referrer: str) -> npt.NDArray[np.int64]:
        """Reads an accessor of unsigned integers, shape (count, components).

        Raises:
            FormatError: The index, type, an offset or a size is invalid.
        """
        values = self._values(self.item("accessors", index, referrer), f"accessors[{index}]", kind)
        if values.dtype.kind != "u":
            raise FormatError(self.path, f"{referrer} needs unsigned integers, accessors[{index}] has {values.dtype}")
        self._count(8 * values.size)
        return values.astype(np.int64)

    def _count(self, decoded_bytes: int) -> None:
        """Adds to the total of decoded bytes, which is limited because many primitives may decode one accessor.

        Raises:
            FormatError: The total is far more than a file of this size can hold.
        """
        self._decoded_bytes += decoded_bytes
        check_expansion(self.path, "its accessors", self._decoded_bytes, self.stored_bytes)

    def view_bytes(self, index: object, referrer: str) -> tuple[memoryview, int | None]:
        """Returns the bytes of a buffer view, and its stride in bytes or None if the view states no stride.

        Raises:
            FormatError: The index is invalid, or the view does not fit into its buffer.
        """
        view = self.item("bufferViews", index, referrer)
        buffer = self._buffer(view.buffer, f"bufferViews[{index}]")
        start, size = view.byteOffset or 0, view.byteLength
        if not (_is_count(start) and _is_count(size)) or start + size > len(buffer):
            raise FormatError(
                self.path,
                f"bufferViews[{index}] needs {size} bytes from {start}, its buffer has {len(buffer):,} bytes",
            )
        return memoryview(buffer)[start : start + size], view.byteStride

    def resource(self, uri: object, referrer: str) -> bytes:
        """Returns the data of a URI: embedded base64 data, or the contents of a file next to the glTF.

        Raises:
            FormatError: The data are damaged, or the file is missing.
        """
        if not isinstance(uri, str) or not uri:
            raise FormatError(self.path, f"{referrer} has neither data nor a file")
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except ValueError as error:
                raise FormatError(self.path, f"{referrer} has damaged base64 data: {error}") from None
        if "://" in uri:
            where = "named by an absolute path" if uri.startswith("file:") else "on the network"
            raise FormatError(self.path, f"{referrer} is {where} ({uri[:60]}): put it beside the file")
        return read_reference(self.path, unquote(uri))

    def _buffer(self, index: object, referrer: str) -> bytes:
        buffer = self.item("buffers", index, referrer)
        assert isinstance(index, int)
        if index not in self._buffers:
            if index == 0 and not buffer.uri and self._binary_chunk is not None:
                data = self._binary_chunk
            else:
                data = self.resource(buffer.uri, f"buffers[{index}]")
                self.stored_bytes += len(data)
            if not _is_count(buffer.byteLength) or len(data) < buffer.byteLength:
                raise FormatError(
                    self.path, f"buffers[{index}] has {len(data):,} bytes, expected {buffer.byteLength}: truncated?"
                )
            self._buffers[index] = data[: buffer.byteLength]
        return self._buffers[index]

    def _values(self, accessor: pygltflib.Accessor, name: str, kind: str) -> _Stored:
        """Returns the values of an accessor in the component type of the file, shape (count, components)."""
        if accessor.type not in kind.split() or accessor.componentType not in _COMPONENT_TYPES:
            raise FormatError(
                self.path, f"{name} has type {accessor.type} of {accessor.componentType}, expected {kind}"
            )
        if not _is_count(accessor.count) or accessor.count == 0:
            raise FormatError(self.path, f"{name} has count {accessor.count}, expected at least 1")
        dtype = np.dtype(_COMPONENT_TYPES[accessor.componentType])
        width = _COMPONENT_COUNTS[accessor.type]
        if accessor.bufferView is not None:
            values = self._rows(accessor, accessor.count, width, dtype, name)
        else:
            check_expansion(self.path, name, accessor.count * width * dtype.itemsize, self.stored_bytes)
            values = np.zeros((accessor.count, width), dtype)
        return self._with_sparse(values, accessor.sparse, name) if accessor.sparse is not None else values

    def _with_sparse(self, values: _Stored, sparse: pygltflib.Sparse, name: str) -> _Stored:
        where, new = sparse.indices, sparse.values
        if not _is_count(sparse.count) or where is None or new is None or where.componentType not in (5121, 5123, 5125):
            raise FormatError(self.path, f"{name} has malformed sparse indices or values")
        index_type = np.dtype(_COMPONENT_TYPES[where.componentType])
        rows = self._rows(where, sparse.count, 1, index_type, name + " sparse indices")
        if rows.size and rows.max() >= len(values):
            raise FormatError(self.path, f"{name} has sparse index {rows.max()}, but only {len(values)} values")
        values = values.copy()
        values[rows[:, 0].astype(np.int64)] = self._rows(
            new, sparse.count, values.shape[1], values.dtype, name + " sparse values"
        )
        return values

    def _rows(self, source: _RowSource, count: int, width: int, dtype: np.dtype[Any], name: str) -> _Stored:
        """Returns ``count`` rows of ``width`` numbers of a buffer view, without copying; rows are one stride apart.

        Args:
            source: Accessor, or part of a sparse accessor, that names the buffer view.
            count: Number of rows.
            width: Numbers per row.
            dtype: Component type.
            name: Name of the accessor in messages.
        """
        data, stored_stride = self.view_bytes(source.bufferView, name)
        row_bytes = width * dtype.itemsize
        offset, stride = source.byteOffset or 0, stored_stride or row_bytes
        if not (_is_count(offset) and _is_count(stride)) or stride < row_bytes:
            raise FormatError(
                self.path, f"{name} has offset {offset} and stride {stride} for rows of {row_bytes} bytes"
            )
        if count and offset + stride * (count - 1) + row_bytes > len(data):
            raise FormatError(
                self.path, f"{name} needs {count:,} rows of {stride} bytes from {offset}, its view has {len(data):,}"
            )
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))


def _extensions(item: object) -> set[str]:
    """Returns the names of all extensions that occur anywhere in the JSON value ``item``."""
    found: set[str] = set()
    pending: list[object] = [item]
    while pending:
        part = pending.pop()
        if isinstance(part, dict):
            values = cast("dict[str, object]", part)
            found |= (
                set(cast("dict[str, object]", extensions))
                if isinstance(extensions := values.get("extensions"), dict)
                else set()
            )
            pending += values.values()
        elif isinstance(part, list):
            pending += cast("list[object]", part)
    return found


def _is_count(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _split_glb(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """Returns the JSON chunk of a GLB file, and its BIN chunk or None if it has none (glTF 2.0, section 4.4)."""
    if len(data) < _GLB_HEADER_BYTES + _CHUNK_HEADER_BYTES:
        raise FormatError(path, f"is a GLB file of {len(data)} bytes: truncated")
    version, length = (int.from_bytes(data[k : k + 4], "little") for k in (4, 8))
    if version != 2:
        raise FormatError(path, f"is GLB version {version}, expected 2")
    if length > len(data):
        raise FormatError(path, f"truncated: {len(data):,} bytes of {length:,}")
    chunks: dict[bytes, bytes] = {}
    offset = _GLB_HEADER_BYTES
    while offset + _CHUNK_HEADER_BYTES <= length:
        size, kind = int.from_bytes(data[offset : offset + 4], "little"), data[offset + 4 : offset + 8]
        offset += _CHUNK_HEADER_BYTES
        if offset + size > len(data):
            raise FormatError(path, f"truncated: a chunk of {size:,} bytes at {offset:,} in {len(data):,}")
        chunks.setdefault(kind, data[offset : offset + size])
        offset += size
    if b"JSON" not in chunks:
        raise FormatError(path, "is a GLB file without a JSON chunk: truncated or damaged")
    return chunks[b"JSON"], chunks.get(b"BIN\0")


@dataclass(frozen=True, slots=True)
class GltfPrimitive:
    """A primitive of a mesh, with the file that contains it."""

    file: GltfFile
    item: pygltflib.Primitive
    where: str
    """Name of the primitive in messages, such as ``meshes[2].primitives[0]``."""

    def floats(self, name: str, kind: str) -> npt.NDArray[np.float32] | None:
        """Reads an attribute as float32, shape (vertices, components); None if the primitive lacks the attribute."""
        accessor = self._accessor(name)
        return None if accessor is None else self.file.floats(accessor, kind, f"{self.where} {name}")

    def integers(self, name: str, kind: str) -> npt.NDArray[np.int64] | None:
        """Reads an attribute of unsigned integers, shape (vertices, components); None if the primitive lacks it."""
        accessor = self._accessor(name)
        return None if accessor is None else self.file.integers(accessor, kind, f"{self.where} {name}")

    def error(self, problem: str) -> FormatError:
        """Returns a `FormatError` that names the file and this primitive."""
        return FormatError(self.file.path, f"{self.where} {problem}")

    def _accessor(self, name: str) -> int | None:
        return getattr(self.item.attributes, name, None)


class GltfDocument:
    """A glTF file being built. Arrays are written to the file directly, so that memory never holds the whole buffer."""

    def __init__(self) -> None:
        self._json: dict[str, Any] = {"asset": {"version": "2.0", "generator": "lumisplat"}}
        self._parts: list[memoryview | bytes] = []
        self._size = 0

    def add(self, collection: str, item: dict[str, Any]) -> int:
        """Appends an item to ``"nodes"``, ``"meshes"``, ..., and returns its index."""
        items: list[dict[str, Any]] = self._json.setdefault(collection, [])
        items.append(item)
        return len(items) - 1

    def count(self, collection: str) -> int:
        """Returns the number of items of a collection."""
        return len(self._json.get(collection, ()))

    def use(self, extension: str, **values: Any) -> dict[str, Any]:
        """Lists an extension in extensionsUsed, and returns the ``extensions`` value for an item that uses it.

        Args:
            extension: Name of the extension.
            **values: Properties of the extension in the item.
        """
        used: list[str] = self._json.setdefault("extensionsUsed", [])
        if extension not in used:
            used.append(extension)
        return {extension: values}

    def add_light(self, light: dict[str, Any]) -> int:
        """Appends a KHR_lights_punctual light, and returns its index."""
        self.use("KHR_lights_punctual")
        lights = self._json.setdefault("extensions", {}).setdefault("KHR_lights_punctual", {"lights": []})["lights"]
        lights.append(light)
        return len(lights) - 1

    def accessor(
        self, values: npt.NDArray[Any], target: int = VERTICES, *, normalized: bool = False, bounds: bool = False
    ) -> int:
        """Appends an array of float32 or unsigned integers as an accessor, and returns the accessor's index.

        Args:
            values: N numbers, shape (N,), or N rows of 1 to 4 numbers. The size of a row of vertex attributes is a
                multiple of four bytes.
            target: Buffer view target, `VERTICES` or `TRIANGLES`.
            normalized: Whether integers represent 0..1.
            bounds: Whether to store the minimum and maximum, as required for positions.
        """
        stored = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"), copy=False)
        rows = stored.reshape(len(stored), -1)
        item: dict[str, Any] = {
            "bufferView": self.view(rows.view(np.uint8).reshape(-1).data, target),
            "componentType": _COMPONENT_CODES[stored.dtype.str[1:]],
            "count": len(rows),
            "type": _KINDS[rows.shape[1]],
        }
        if normalized:
            item["normalized"] = True
        if bounds:
            item |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self.add("accessors", item)

    def view(self, data: memoryview | bytes, target: int | None = None) -> int:
        """Appends bytes to the buffer as a buffer view, and returns the index of the view."""
        item = {"buffer": 0, "byteOffset": self._size, "byteLength": len(data)}
        padding = bytes(-len(data) % 4)
        self._parts += [data, padding]
        self._size += len(data) + len(padding)
        return self.add("bufferViews", item | ({} if target is None else {"target": target}))

    def save(self, path: PathLike, nodes: list[int]) -> None:
        """Writes a GLB file, or, for a ``.gltf`` path, JSON with the buffer embedded as base64.

        Args:
            path: The file. It appears complete or not at all.
            nodes: Indices of the scene's root nodes.

        Raises:
            FormatError: The file would be too large, or cannot be written.
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
            raise FormatError(
                path, f"would have {length:,} bytes, but a GLB has at most {_GLB_MAX:,}: save the scene in parts"
            )
        file.write(struct.pack("<4sII", b"glTF", 2, length))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        if self._parts:
            file.write(struct.pack("<I4s", self._size, b"BIN\0"))
            for part in self._parts:
                file.write(part)


def _encoded(document: dict[str, Any]) -> bytes:
    """Encodes the JSON document as UTF-8. Bytes of file names that are not text become question marks."""
    return json.dumps(document, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode("utf-8", "replace")
