"""Untrusted NumPy archives: nothing is allocated or executed before headers are checked."""

from __future__ import annotations

import io
import os
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.files.arrays import checked_array, read_arrays

KIND = "a table of numbers"


def header(shape: tuple[int, ...], descr: str = "<f4") -> bytes:
    """Returns the header of an array file that claims a shape."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": descr, "fortran_order": False, "shape": shape})
    return stream.getvalue()


def archive(path: Path, *members: tuple[str, bytes], method: int = zipfile.ZIP_STORED) -> Path:
    """Writes a zip archive of the given members."""
    with zipfile.ZipFile(path, "w", method) as file:
        for name, content in members:
            file.writestr(name, content)
    return path


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_read_from_npz_archives_equal_those_written(tmp_path: Path, save: Any) -> None:
    """The arrays have all number types, empty and scalar shapes, Fortran order and text."""
    written = {
        "a": np.arange(6, dtype=np.float32).reshape(2, 3),
        "b": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "c": np.array("text"),
        "d": np.zeros((0, 3), np.int32),
    }
    save(tmp_path / "a.npz", **written)
    read = read_arrays(tmp_path / "a.npz", KIND, compressed=True)
    assert read.keys() == written.keys()
    for name, array in written.items():
        np.testing.assert_array_equal(read[name], array)


@pytest.mark.parametrize(
    "members",
    [
        [("a.npy", header((2**40, 2**20)) + bytes(8))],
        [("a.npy", header((-4,)) + bytes(8))],
        [("a.npy", header((4,)) + bytes(15))],
        [("a.npy", header((2,)) + bytes(16))],
        [("a.npy", header((1,), "|O") + b"cos\nsystem\n(S'true'\ntR.")],
        [("a.npy", b"\x93NUMPY\x01\x00")],
        [("a.npy", b"")],
        [("a.txt", b"text")],
        [("a.npy", b"\x93NUMPY\x07\x00" + header((1,))[8:] + bytes(4))],
    ],
    ids=["endless", "negative", "short", "long", "objects", "cut", "empty", "text", "version"],
)
def test_invalid_npz_archives_are_refused_with_a_one_line_error(
    tmp_path: Path, members: list[tuple[str, bytes]]
) -> None:
    """False headers, pickled objects that would run code, and other files are refused."""
    with pytest.raises(ls.FormatError, match=f"a.npz: (is damaged, or not {KIND}$|a holds Python objects)"):
        read_arrays(archive(tmp_path / "a.npz", *members), KIND)


def test_npz_decompression_bomb_is_refused_before_unpacking(tmp_path: Path) -> None:
    """A gigabyte of zeros fits in a megabyte; unless ``compressed`` is given, every compressed archive is refused."""
    size = 2**28
    path = archive(tmp_path / "a.npz", ("a.npy", header((size,)) + bytes(4 * size)), method=zipfile.ZIP_DEFLATED)
    tracemalloc.start()
    try:
        with pytest.raises(ls.FormatError, match="made to exhaust memory"):
            read_arrays(path, KIND, compressed=True)
        with pytest.raises(ls.FormatError, match=f"not {KIND}$"):
            read_arrays(path, KIND)
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


def test_npz_archives_with_overlapping_members_are_refused(tmp_path: Path) -> None:
    """Many directory entries for one stored array would take many times the memory of the file."""
    path, content = tmp_path / "a.npz", header((2**16,)) + bytes(2**18)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("a.npy", content)
        first = file.infolist()[0]
        for number in range(8):
            other = zipfile.ZipInfo(f"b{number}.npy")
            other.CRC, other.compress_size, other.file_size = first.CRC, first.compress_size, first.file_size
            other.header_offset = first.header_offset
            file.filelist.append(other)
    with pytest.raises(ls.FormatError, match=f"not {KIND}$"):
        read_arrays(path, KIND)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes here")
def test_npz_reader_has_different_errors_for_pipes_folders_and_missing_files(tmp_path: Path) -> None:
    """The reader opens neither the pipe nor the folder."""
    os.mkfifo(tmp_path / "pipe.npz")
    with pytest.raises(ls.FormatError, match=r"pipe\.npz: is a device, a pipe or a socket"):
        read_arrays(tmp_path / "pipe.npz", KIND)
    with pytest.raises(ls.FormatError, match="is a folder"):
        read_arrays(tmp_path, KIND)
    with pytest.raises(ls.errors.MissingFileError):
        read_arrays(tmp_path / "missing.npz", KIND)


def test_npz_arrays_must_have_the_expected_shape_and_be_finite() -> None:
    """The error names an array of another rank, length, type or of non-finite values."""
    arrays: dict[str, Any] = {"a": np.ones((4, 3)), "text": np.array(["1"]), "huge": np.array([1e300])}
    assert checked_array(arrays, "a", (None, 3), np.float32).dtype == np.float32
    for name, shape in (("a", (4,)), ("a", (5, 3)), ("b", (4, 3)), ("text", (1,)), ("huge", (1,))):
        with pytest.raises(ValueError, match=name):
            checked_array(arrays, name, shape, np.float32)
