"""Points of COLMAP's sparse models: ``points3D``, .bin or .txt; their tracks are left out."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.cameras.colmap import text_lines
from lumisplat.io.files.source import parsing, read_bytes
from lumisplat.math.arrays import Doubles, FloatArray

_POINT = np.dtype([("number", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
"""A point of a .bin file, before its track."""
_TRACK_BYTES = 8
_TRACK_AT = _POINT.itemsize - 8


def read_colmap_points(folder: Path) -> tuple[Doubles, FloatArray] | None:
    """The points of a model.

    Args:
        folder: The folder of the model; .bin is read before .txt, as COLMAP does.

    Returns:
        Positions in world space, shape (N, 3), and display-referred colours, 0..1, shape (N, 3); None: it has none.

    Raises:
        FormatError: The file is damaged or truncated, or has a position that is not finite.
    """
    path = next((path for name in ("points3D.bin", "points3D.txt") if (path := folder / name).is_file()), None)
    if path is None:
        return None
    with parsing(path, "the points of a sparse model of COLMAP"):
        positions, colors = _read_binary(path) if path.suffix == ".bin" else _read_text(path)
        if not len(positions):
            return None
        finite = np.asarray(np.isfinite(positions).all(axis=1))
        if not finite.all():
            first, count = finite.argmin(), np.count_nonzero(~finite)
            raise FormatError(
                path, f"has {count:,} of {finite.size:,} points without a finite position, the first is {first:,}"
            )
        return positions, colors / np.float32(255.0)


def _read_binary(path: Path) -> tuple[Doubles, FloatArray]:
    data = read_bytes(path)
    (count,) = struct.unpack_from("<Q", data)
    length, at, starts = struct.Struct("<Q"), 8, list[int]()
    if count * _POINT.itemsize > len(data):
        raise FormatError(path, f"is to hold {count:,} points, and has {len(data):,} bytes: it is cut off")
    for _ in range(count):
        starts.append(at)
        at += _POINT.itemsize + _TRACK_BYTES * length.unpack_from(data, at + _TRACK_AT)[0]
    if at > len(data):
        raise FormatError(path, f"is cut off in the last of {count:,} points")
    rows = np.asarray(starts, np.int64)[:, None] + np.arange(_POINT.itemsize)
    points = np.frombuffer(data, np.uint8)[rows].view(_POINT)[:, 0]
    return points["xyz"].astype(np.float64), points["rgb"].astype(np.float32)


def _read_text(path: Path) -> tuple[Doubles, FloatArray]:
    rows = [line.split(maxsplit=7)[1:7] for line in text_lines(path)]
    short = next((index for index, row in enumerate(rows) if len(row) < 6), None)
    if short is not None:
        raise FormatError(path, f"point {short:,} has too few values, expected a number, X Y Z, R G B and an error")
    values = np.array(rows, np.float64).reshape(-1, 6)
    if (values[:, 3:] < 0.0).any() or (values[:, 3:] > 255.0).any():
        raise FormatError(path, "has a colour outside of 0..255")
    return values[:, :3], values[:, 3:].astype(np.float32)
