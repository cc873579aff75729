"""PLY list properties: rows of equal and different lengths, among other properties, in every encoding."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from lumisplat.io.ply import read_ply_header, read_ply_lists

HEADER = """ply
format {} 1.0
element before 2
property double time
element face {}
property short before
property list uchar int corners
property float between
property list ushort float weights
property uchar after
end_header
"""
EQUAL = [([7, 8, 9], [0.5]), ([1, 2, 3], [0.25]), ([4, 5, 6], [-2.0])]
MIXED = [([7, 8, 9], [0.5]), ([], [0.25, 1.0]), ([4, -5], [])]
"""Lists of different lengths, some empty."""


def ply(path: Path, encoding: str, rows: list[tuple[list[int], list[float]]]) -> Path:
    """Writes a file of the rows, between other elements and properties."""
    if encoding == "ascii":
        lines = ["1.5", "2.5"]
        for corners, weights in rows:
            numbers = [-1, len(corners), *corners, 0.125, len(weights), *weights, 200]
            lines.append(" ".join(map(str, numbers)))
        body = "\n".join([*lines, "99 trailing"]).encode()
    else:
        order = "<" if "little" in encoding else ">"
        body = struct.pack(order + "2d", 1.5, 2.5)
        for corners, weights in rows:
            kinds = f"{order}hB{len(corners)}ifH{len(weights)}fB"
            body += struct.pack(kinds, -1, len(corners), *corners, 0.125, len(weights), *weights, 200)
    path.write_bytes(HEADER.format(encoding, len(rows)).encode() + body)
    return path


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("rows", [EQUAL, MIXED, MIXED[1:], MIXED[::-1], EQUAL[:1], []])
def test_ply_lists_of_any_lengths_and_encodings_are_read_exactly(
    tmp_path: Path, encoding: str, rows: list[tuple[list[int], list[float]]]
) -> None:
    """Counts and items are equal, in the number types of the file."""
    header = read_ply_header(ply(tmp_path / "a.ply", encoding, rows))
    lists = read_ply_lists(header, header.required("face"))
    assert sorted(lists) == ["corners", "weights"]
    for k, (name, dtype) in enumerate((("corners", np.int32), ("weights", np.float32))):
        np.testing.assert_array_equal(lists[name].counts, [len(row[k]) for row in rows])
        np.testing.assert_array_equal(lists[name].items, [item for row in rows for item in row[k]])
        assert lists[name].items.dtype == dtype
