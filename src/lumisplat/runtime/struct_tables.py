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
    """An array of structs, some of whose fields may be arrays; without rows, one of an empty struct."""
    instances: Any = rows
    values: list[Any] = [row.__ctype__() for row in instances]
    packed: Any = (values[0].__class__ * len(values))(*values)
    address = ctypes.addressof(packed)
    table = DeviceArray(shape=len(rows), dtype=struct, device=device)
    table.assign(DeviceArray(ptr=address, dtype=struct, shape=len(rows), device="cpu", copy=False))
    table.kept = instances
    return table
