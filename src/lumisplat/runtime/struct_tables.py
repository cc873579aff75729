"""Tables of structs: filled in NumPy, or uploaded if their fields are arrays themselves."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from lumisplat.runtime.buffers import DeviceArray


def table_dtype(struct: type[object]) -> np.dtype[np.void]:
    """The NumPy dtype of a Warp struct's rows."""
    noun: Any = struct
    return np.dtype(noun.numpy_dtype())


def upload_structs(rows: Sequence[object], struct: type[object], device: str) -> DeviceArray:
    """An array of structs, some of whose fields may be arrays: these live at least as long as it does.

    Without rows it has one empty struct: an array without elements has no address. Bytes are copied as they are,
    because Warp's own conversion of such structs takes milliseconds.
    """
    instances: Any = list(rows) or [struct()]
    values: list[Any] = [row.__ctype__() for row in instances]
    packed: Any = (values[0].__class__ * len(values))(*values)
    address, count = ctypes.addressof(packed), len(values)
    table = DeviceArray(shape=count, dtype=struct, device=device)
    table.assign(DeviceArray(ptr=address, dtype=struct, shape=count, device="cpu", copy=False))
    table.kept = instances
    return table
