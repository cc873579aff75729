"""Tables of structs: filled in NumPy, or uploaded if their fields are arrays themselves."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from lumisplat.runtime.buffers import DeviceArray, assign_table, rows_of


@cache
def table_dtype(struct: type[object]) -> np.dtype[np.void]:
    """The NumPy dtype of a Warp struct's rows; cached, as Warp derives it anew each time."""
    noun: Any = struct
    return np.dtype(noun.numpy_dtype())


def upload_structs(rows: Sequence[object], struct: type[object], device: str) -> DeviceArray:
    """An array of structs, some of whose fields may be arrays: these live at least as long as it does.

    On a GPU, some of them are copies that nothing else holds, while the table has their bare addresses.
    Without rows it has one empty struct: an array without elements has no address.
    """
    instances: Any = list(rows) or [struct()]
    table = DeviceArray(shape=len(instances), dtype=struct, device=device)
    assign_table(table, rows_of(instances))
    table.kept = instances
    return table


def upload_table(table: np.ndarray, struct: type[object], device: str) -> DeviceArray:
    """An array of structs from the rows of ``table_dtype``, of which there is at least one."""
    array = DeviceArray(shape=len(table), dtype=struct, device=device)
    assign_table(array, table)
    return array
