"""Converts a pickled body model, as SMPL's authors distribute it, to .npz without running what the pickle names.

    python -m lumisplat.io.rigs.convert_pickle SMPL_NEUTRAL.pkl

A pickle names the classes and functions that make its objects. All are replaced by one that only keeps what it is
given, so nothing is imported or called. The arrays are then made from the kept bytes.
"""

from __future__ import annotations

import io
import pickle
import struct
import sys
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, LumisplatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import is_object, parsing, read_bytes
from lumisplat.io.rigs.body_model import ARRAYS

_BASE: Any = pickle._Unpickler  # pyright: ignore[reportPrivateUsage, reportAttributeAccessIssue]


class _Kept:
    """Stands for any object of a pickle: the arguments that would make it, its state, and its array once made."""

    args: tuple[Any, ...]
    state: Any = None
    array: npt.NDArray[Any] | None = None

    def __new__(cls, *args: Any) -> _Kept:
        if len(args) > 16:  # each object copies them, and a short file can make many
            raise ValueError(f"an object has {len(args)} arguments")
        kept = super().__new__(cls)
        kept.args = args
        return kept

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(_BASE):
    """Makes objects in Python, because pickle.Unpickler allocates as much memory as numbers in the file say."""

    def find_class(self, module: str, name: str) -> type[_Kept]:
        return _Kept

    def load_bytearray8(self) -> None:
        self.append(bytearray(self.read(*struct.unpack("<Q", self.read(8)))))

    def load_list_of(self, length: int) -> None:
        self.stack[-length:] = [self.stack[-length:]]

    dispatch: ClassVar[dict[int, Any]] = _BASE.dispatch | {
        pickle.BYTEARRAY8[0]: load_bytearray8,
        pickle.TUPLE1[0]: partial(load_list_of, length=1),
        pickle.TUPLE2[0]: partial(load_list_of, length=2),
        pickle.TUPLE3[0]: partial(load_list_of, length=3),
        pickle.TUPLE[0]: _BASE.load_list,  # lists are no keys: Python crashes when it hashes a deeply nested tuple
        **dict.fromkeys((pickle.EMPTY_TUPLE[0], pickle.EMPTY_SET[0]), _BASE.load_empty_list),
        pickle.ADDITEMS[0]: _BASE.load_appends,
    }


def main() -> None:
    """Writes the arrays of a pickle into a .npz beside it."""
    if len(sys.argv) != 2:
        sys.exit("usage: python -m lumisplat.io.rigs.convert_pickle FILE.pkl")
    written = Path(sys.argv[1]).with_suffix(".npz")
    try:
        if written.exists():
            raise FormatError(written, "already exists: use it, or move it away to convert the pickle")
        arrays = read_pickled_arrays(Path(sys.argv[1]))
        with atomic_write(written) as temporary:
            np.savez_compressed(temporary, **arrays)  # pyright: ignore[reportArgumentType] # names are keywords
    except LumisplatError as error:
        sys.exit(f"error: {error}")
    print(written)


def read_pickled_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Reads the arrays of a pickled body model: those of NumPy, of SciPy's csc_matrix, and of chumpy's Ch and Select.

    Raises:
        FormatError: The file is missing, no pickle of a body model, or its arrays take far more memory than the file.
    """
    data = read_bytes(path)
    with parsing(path, "a pickle"):
        try:
            content: object = _Unpickler(io.BytesIO(data), encoding="latin1").load()
        except (pickle.UnpicklingError, KeyError, BufferError) as error:
            raise FormatError(path, "damaged, or not a pickle") from error
        found = content if is_object(content) else {}
        free = [8 * len(data) + 64 * 2**20]  # bytes that all arrays may take
        arrays = {name: _array(found[name], free) for name in ARRAYS if isinstance(found.get(name), _Kept)}
    if not arrays:
        raise FormatError(path, "holds no arrays of a body model (SMPL)")
    return arrays


def _array(kept: _Kept, free: list[int]) -> npt.NDArray[Any]:
    """Makes the array of an object once, and subtracts it from the number of bytes that arrays may still take."""
    if kept.array is None:
        kept.array = _made(kept, free)
        free[0] -= kept.array.nbytes
    if free[0] < 0:
        raise ValueError("its arrays take far more memory than the file")
    return kept.array


def _made(kept: _Kept, free: list[int]) -> npt.NDArray[Any]:
    """Makes an array of its object's state, of the matrix or chumpy object around it, or of its arguments."""
    match kept.state, kept.args:
        case None, (data, dtype, shape, order):  # numpy's _frombuffer, of protocol 5
            return _of_bytes(data, dtype).reshape(shape, order=order)
        case [_, shape, dtype, is_fortran, data], _:
            return _of_bytes(data, dtype).reshape(shape, order="F" if is_fortran else "C")
        case {"indices": _, "indptr": _, "data": _, "_shape": shape}, _:
            rows, starts, values = (_array(kept.state[key], free) for key in ("indices", "indptr", "data"))
            columns = np.searchsorted(starts, np.arange(rows.size), side="right") - 1
            dense = np.zeros(shape)  # takes memory only where numbers are added
            if dense.nbytes <= free[0]:
                np.add.at(dense, (rows.ravel(), columns), values)
            return dense
        case {"a": whole, "idxs": indices, "preferred_shape": shape}, _:
            return _array(whole, free).ravel()[_array(indices, free)].reshape(shape)
        case {"x": inner}, _:
            return _array(inner, free)
        case _:
            raise ValueError("an object is no array that is known")


def _of_bytes(data: Any, kept: _Kept) -> npt.NDArray[Any]:
    """Returns the numbers in the bytes of an array, which old protocols write as text in Latin-1."""
    content = data.args[0] if isinstance(data, _Kept) else data
    dtype = np.dtype(kept.args[0] if isinstance(kept.args[0], str) else object).newbyteorder(kept.state[1])
    if dtype.kind not in "biuf":
        raise ValueError(f"an array of {dtype}, expected numbers")
    return np.frombuffer(content.encode("latin1") if isinstance(content, str) else content, dtype)


if __name__ == "__main__":
    main()
