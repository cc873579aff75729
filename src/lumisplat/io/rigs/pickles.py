"""Reads arrays from pickles, in which SMPL's authors distribute body models, without running what a pickle names.

A pickle names the classes and functions that make its objects. All of them are replaced by one that only keeps what it
is given, so nothing is imported or called. The arrays are then made from the kept bytes.
"""

from __future__ import annotations

import io
import pickle
import struct
from collections.abc import Collection
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
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


def read_pickled_arrays(path: Path, kind: str, names: Collection[str]) -> dict[str, _Array]:
    """Reads arrays from a pickled dictionary: those of NumPy, of SciPy's csc_matrix, and of chumpy's Ch and Select.

    Args:
        path: The file.
        kind: The expected kind of file for messages.
        names: Keys of the arrays to read, if the dictionary has them; others may hold anything.

    Raises:
        FormatError: The file is no pickle of a dictionary, or an array in it is damaged.
        MissingFileError: There is no such file.
    """
    data = read_bytes(path)
    try:
        content: Any = _Unpickler(io.BytesIO(data), encoding="latin1").load()
        if not isinstance(content, dict):
            raise TypeError("no dictionary")
        held = cast("dict[object, object]", content)
        return {name: _array(value) for name in names if isinstance(value := held.get(name), _Kept)}
    except (*_DAMAGES, pickle.UnpicklingError) as error:
        raise FormatError(path, f"damaged, or not {kind}") from error


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
