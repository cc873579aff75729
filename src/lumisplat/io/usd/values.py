"""Values of a prim's attributes as arrays and numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.usd.stage import HINT, UsdFile


def value(file: UsdFile, prim: Any, name: str, default: Any = None) -> Any:
    """The value of an attribute at the time that is shown; the default if there is none."""
    attribute = prim.GetAttribute(name)
    found = attribute.Get(file.time) if attribute else None
    return default if found is None else found


def shortest(found: float) -> float:
    """A number; of one that has 32 bits, the shortest decimal that it stands for: 0.4, not 0.4000000059604645."""
    single = np.float32(found)
    return float(str(single)) if float(single) == found else float(found)


def hints_of(prim: Any) -> dict[str, Any]:
    """What we have noted at a prim, in files of ours."""
    found = prim.GetCustomDataByKey(HINT)
    return found if isinstance(found, dict) else {}  # pyright: ignore[reportUnknownVariableType]


def number(file: UsdFile, prim: Any, name: str, default: float) -> float:
    """A number.

    Raises:
        FormatError: It is none.
    """
    found = value(file, prim, name, default)
    try:
        return shortest(float(found))
    except (TypeError, ValueError):
        raise FormatError(file.path, f"{prim.GetPath()}.{name} is {str(found)[:40]!r}, expected a number") from None


def array(file: UsdFile, prim: Any, name: str, columns: int) -> npt.NDArray[np.float32] | None:
    """An array of rows, shape (N, columns), or (N,) for one column; None if it has no rows.

    Raises:
        FormatError: It has other rows.
    """
    found = value(file, prim, name)
    return None if found is None else rows(file, f"{prim.GetPath()}.{name}", found, columns)


def rows(file: UsdFile, label: str, found: Any, columns: int) -> npt.NDArray[np.float32] | None:
    """As `array`, of a value that is there."""
    try:
        held = np.array(found, dtype=np.float32)
    except (TypeError, ValueError):
        raise FormatError(file.path, f"{label} is no array of numbers") from None
    if held.size == 0:
        return None
    if held.shape[1:] != ((columns,) if columns > 1 else ()):
        raise FormatError(file.path, f"{label} has rows of shape {held.shape[1:]}, expected {columns} numbers")
    return held


def whole_numbers(file: UsdFile, prim: Any, name: str) -> npt.NDArray[np.int64]:
    """An array of whole numbers, shape (N,); empty if there is none.

    Raises:
        FormatError: They are none.
    """
    found = np.array(value(file, prim, name, ()))
    if found.size == 0:
        return np.zeros(0, np.int64)
    if found.dtype.kind not in "iu" or found.ndim != 1:
        raise FormatError(file.path, f"{prim.GetPath()}.{name} is no array of whole numbers")
    return found.astype(np.int64)
