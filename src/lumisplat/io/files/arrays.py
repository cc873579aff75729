"""Reads and writes NumPy archives (``.npz``), checking names, types and sizes before allocating anything."""

from __future__ import annotations

import math
import os
import zipfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike, check_expansion, check_memory, opened, readable
from lumisplat.math.arrays import host_array

_UNREADABLE = (ValueError, LookupError, TypeError, ArithmeticError, RuntimeError, EOFError, SyntaxError)
"""Exceptions, besides those of zipfile and zlib, that NumPy and zipfile raise for damaged archives."""


def read_arrays(
    path: PathLike, kind: str, *, compressed: bool = False, names: Collection[str] | None = None
) -> dict[str, npt.NDArray[Any]]:
    """Reads the arrays of an archive.

    Args:
        path: The file.
        kind: The expected kind of file for messages, such as ``"a checkpoint of a training"``.
        compressed: Whether arrays may be compressed, as by `numpy.savez_compressed`. Otherwise the arrays take no more
            memory than the file has bytes.
        names: Names of the arrays to read, if the archive holds them; others may hold anything. None reads all.

    Raises:
        FormatError: The file cannot be read, or is a folder, a device or a pipe. Or the file is no NumPy archive, holds
            Python objects, or claims far more memory than a file of its size can hold.
        MissingFileError: There is no such file.
    """
    try:
        with readable(path), opened(path, largest=math.inf) as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            if names is not None:
                members = [member for member in members if member.filename.removesuffix(".npy") in names]
            sizes = [_array_bytes(archive, member, compressed) for member in members]
            if len({member.filename for member in members}) < len(members):
                raise ValueError("two arrays of one name")
            stored = os.fstat(file.fileno()).st_size
            check_expansion(path, "its arrays", sum(sizes), stored)
            check_memory(path, "its arrays", sum(sizes), "it needs a machine with more")
            if not compressed and sum(sizes) > stored:
                raise ValueError("arrays that overlap")
            return {member.filename.removesuffix(".npy"): _read(archive, member) for member in members}
    except FormatError:
        raise
    except _HoldsObjectsError as error:
        if names is None:  # not a file of this kind
            raise FormatError(path, f"is damaged, or not {kind}") from None
        raise FormatError(
            path,
            f"{error} holds Python objects, which are not read: save it as an array of numbers "
            f"(a sparse matrix: {error}.item().toarray())",
        ) from None
    except (*_UNREADABLE, zipfile.BadZipFile, zlib.error):
        raise FormatError(path, f"is damaged, or not {kind}") from None


def checked_array(
    arrays: dict[str, npt.NDArray[Any]], name: str, shape: tuple[int | None, ...], dtype: npt.DTypeLike
) -> npt.NDArray[Any]:
    """Returns an array of an archive, converted to ``dtype``, after checking its shape and that all values are finite.

    Args:
        arrays: Result of `read_arrays`.
        name: Name of the array.
        shape: Expected shape; None allows any length of that axis.
        dtype: Type of the result.

    Raises:
        ValueError: The array is missing, or has another shape or non-finite values.
    """
    array = arrays.get(name)
    if array is None or array.dtype.kind not in "fiub" or array.ndim != len(shape):
        raise ValueError(f"no array {name} of {len(shape)} axes")
    if any(expected_length not in (None, length) for expected_length, length in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name} has the shape {array.shape}, expected {shape}")
    with np.errstate(all="ignore"):
        values = array.astype(dtype)
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds values that are not finite")
    return values


class _HoldsObjectsError(ValueError):
    """An array of an archive holds Python objects; the argument is its name."""


def _array_bytes(archive: zipfile.ZipFile, member: zipfile.ZipInfo, compressed: bool) -> int:
    """Returns how many bytes of memory one array of an archive will take, computed from its header before reading.

    Raises:
        _HoldsObjectsError: The member holds Python objects.
        ValueError: The member is no array file, is compressed although ``compressed`` is False, or has another size
            than its header states.
    """
    methods = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) if compressed else (zipfile.ZIP_STORED,)
    if member.compress_type not in methods or not member.filename.endswith(".npy"):
        raise ValueError("not what NumPy writes")
    with archive.open(member) as stream:
        shape, dtype, header = _header(stream)
    if dtype.hasobject:
        raise _HoldsObjectsError(member.filename.removesuffix(".npy"))
    size = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or header + size != member.file_size:
        raise ValueError("a size that is not that of the array")
    return size


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any], int]:
    """Reads the header of an array file. Returns the array's shape, its type, and the length of the header in bytes."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, _, dtype = readers[np.lib.format.read_magic(stream)](stream)
    return shape, dtype, stream.tell()


def _read(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> npt.NDArray[Any]:
    with archive.open(member) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


def write_npz(path: PathLike, arrays: Mapping[str, npt.ArrayLike]) -> None:
    """Writes named arrays unchanged. The file appears complete or not at all.

    Raises:
        FormatError: The file cannot be written.
    """
    with atomic_write(path) as temporary, Path(temporary).open("wb") as stream:
        named = {name: np.asarray(host_array(array)) for name, array in arrays.items()}
        np.savez_compressed(stream, **named)  # pyright: ignore[reportArgumentType]
