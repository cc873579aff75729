"""Reads STL files, binary and ASCII: separate triangles without a material."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.source import decode_text, parsing, read_bytes
from lumisplat.io.meshes.mesh_arrays import TriangleSieve
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.mesh import Mesh

_log = logging.getLogger("lumisplat")

_HEADER_BYTES = 84
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_NUMBER = rb"\s+([^\s]+)"
_VERTEX = re.compile(rb"\bvertex" + 3 * _NUMBER, re.IGNORECASE)
_LOOP = re.compile(rb"\bfacet\b", re.IGNORECASE)
_END = re.compile(rb"\bendfacet\b", re.IGNORECASE)
_SPACED_END = re.compile(rb"\bend\s+(?=(?:solid|facet|loop)\b)", re.IGNORECASE)
"""Matches the ``end `` of ``end solid``, ``end facet`` and ``end loop``, which some writers use for ``endsolid`` and
so on."""


def read_stl(path: Path) -> Mesh:
    """Reads triangles as stored, with three vertices each and flat shading.

    Raises:
        FormatError: The file is truncated, or not an STL.
    """
    with parsing(path, "an STL file"):
        corners = _corners(path, read_bytes(path))
        indices = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
        sieve = TriangleSieve(path)
        usable = sieve.usable(corners, indices)
        sieve.report(any_usable=bool(usable.any()))
        return Mesh(corners, indices[usable], name=path.stem)


def _corners(path: Path, data: bytes) -> FloatArray:
    """Returns the three corners of each of F triangles, shape (3 F, 3)."""
    count = int.from_bytes(data[80:_HEADER_BYTES], "little") if len(data) >= _HEADER_BYTES else 0
    expected = _HEADER_BYTES + count * _TRIANGLE.itemsize
    # The length decides, not the word "solid": binary files may begin with it too.
    if len(data) >= _HEADER_BYTES and len(data) == expected:
        return np.frombuffer(data, _TRIANGLE, count, _HEADER_BYTES)["corners"].reshape(-1, 3)
    text = decode_text(data, "replace").encode()
    if text.lstrip()[:5].lower() == b"solid" and _LOOP.search(text):
        return _ascii_corners(path, text)
    if count and len(data) > expected:
        _log.warning("%s: %s bytes after its last triangle are ignored", path, f"{len(data) - expected:,}")
        return np.frombuffer(data, _TRIANGLE, count, _HEADER_BYTES)["corners"].reshape(-1, 3)
    raise FormatError(path, f"has {len(data):,} bytes, expected {expected:,} for an STL of {count:,} triangles")


def _ascii_corners(path: Path, data: bytes) -> FloatArray:
    data = _SPACED_END.sub(b"end", data)
    facets, closed = len(_LOOP.findall(data)), len(_END.findall(data))
    corners = np.array(_VERTEX.findall(data)).astype(np.float32).reshape(-1, 3)
    if len(corners) != 3 * facets or closed != facets or b"endsolid" not in data.lower():
        raise FormatError(path, f"{facets:,} facets begin, {closed:,} end, with {len(corners):,} vertices: truncated?")
    return corners
