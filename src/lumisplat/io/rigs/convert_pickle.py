"""Converts a pickled body model, as SMPL's authors distribute it, to .npz without running what the pickle names.

    python -m lumisplat.io.rigs.convert_pickle SMPL_NEUTRAL.pkl

A pickle names the classes and functions that make its objects. All of them are replaced by one that only keeps what it
is given, so nothing is imported or called. The arrays are then made from the kept bytes.
"""

from __future__ import annotations

import contextlib
import io
import pickle
import struct
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, LumisplatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import read_bytes

_Array = npt.NDArray[Any]
_DAMAGES = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, EOFError, struct.error)
"""Exceptions that Python raises for damaged pickles, besides its own."""


class _Kept:
    """Stands for any object of a pickle: the arguments that would make it, and its state."""

    args: tuple[Any, ...]
    state: Any

    def __new__(cls, *args: Any) -> _Kept:
        kept = super().__new__(cls)
        kept.args, kept.state = args, None
        return kept

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle._Unpickler):  # pyright: ignore[reportPrivateUsage]
    """Makes objects in Python: the memory that pickle.Unpickler takes for its memo is a number in the file."""

    def find_class(self, module: str, name: str) -> type[_Kept]:
        return _Kept


def main() -> None:
    """Writes the arrays of a pickle into a .npz beside it."""
    if len(sys.argv) != 2:
        sys.exit("usage: python -m lumisplat.io.rigs.convert_pickle FILE.pkl")
    path = Path(sys.argv[1])
    try:
        arrays = read_pickled_arrays(path)
        written = path.with_suffix(".npz")
        with atomic_write(written) as temporary:
            np.savez_compressed(temporary, **arrays)  # pyright: ignore[reportArgumentType] # names are keywords
    except LumisplatError as error:
        sys.exit(f"error: {error}")
    print(written)


def read_pickled_arrays(path: Path) -> dict[str, _Array]:
    """Reads the arrays of a pickled dictionary: those of NumPy, of SciPy's csc_matrix, and of chumpy's Ch and Select.

    Entries that are no such arrays are left out.

    Args:
        path: The file.

    Raises:
        FormatError: The file is no pickle of a dictionary of arrays.
        MissingFileError: There is no such file.
    """
    data = read_bytes(path)
    try:
        content: Any = _Unpickler(io.BytesIO(data), encoding="latin1").load()
    except (*_DAMAGES, pickle.UnpicklingError) as error:
        raise FormatError(path, "damaged, or not a pickle") from error
    arrays: dict[str, _Array] = {}
    for name, value in cast("dict[object, object]", content).items() if isinstance(content, dict) else ():
        with contextlib.suppress(*_DAMAGES):
            if isinstance(name, str) and isinstance(value, _Kept):
                arrays[name] = _array(value)
    if not arrays:
        raise FormatError(path, "holds no arrays, expected a body model (SMPL)")
    return arrays


def _array(kept: _Kept) -> _Array:
    """Makes an array of the state of its object, of the matrix or chumpy object around it, or of its arguments."""
    state = kept.state
    if state is None:  # numpy's _frombuffer, of protocol 5
        data, dtype, shape, order = kept.args
        return _of_bytes(data, dtype).reshape(shape, order=order)
    if isinstance(state, tuple):
        _, shape, dtype, is_fortran, data = cast("tuple[Any, ...]", state)
        return _of_bytes(data, dtype).reshape(shape, order="F" if is_fortran else "C")
    if "indptr" in state:
        rows, starts = _array(state["indices"]), _array(state["indptr"])
        columns = np.searchsorted(starts, np.arange(len(rows)), side="right") - 1
        dense = np.zeros(state["_shape"])
        np.add.at(dense, (rows, columns), _array(state["data"]))
        return dense
    if "idxs" in state:
        return _array(state["a"]).ravel()[_array(state["idxs"])].reshape(state["preferred_shape"])
    return _array(state["x"])


def _of_bytes(data: Any, kept: _Kept) -> _Array:
    """Returns the numbers in the bytes of an array, which old protocols write as text in Latin-1."""
    if isinstance(data, _Kept):
        data = data.args[0]
    dtype = np.dtype(str(kept.args[0])).newbyteorder(kept.state[1])
    if dtype.kind not in "biuf":
        raise ValueError(f"an array of {dtype}, expected numbers")
    return np.frombuffer(data.encode("latin1") if isinstance(data, str) else data, dtype)


if __name__ == "__main__":
    main()
