"""Tables of structs: filled in NumPy, or uploaded row by row if their fields are arrays."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

from lumisplat.runtime.buffers import DeviceArray, assign_table, rows_of


@cache
def table_dtype(struct: type[object]) -> np.dtype[np.void]:
    """Returns the NumPy dtype of a Warp struct's rows; cached, because Warp derives it anew each time."""
    struct_type: Any = struct
    return np.dtype(struct_type.numpy_dtype())


def upload_structs(rows: Sequence[object], struct: type[object], device: str) -> DeviceArray:
    """Uploads structs whose fields may be arrays, and keeps these arrays alive as long as the returned table.

    On a GPU, the table holds the addresses of the arrays, some of which are copies that nothing else references.
    Without rows, the table has one empty struct, because an array without elements has no address.
    """
    instances: Any = list(rows) or [struct()]
    table = DeviceArray(shape=len(instances), dtype=struct, device=device)
    assign_table(table, rows_of(instances))
    table.keep_alive = instances
    return table


def upload_table(table: np.ndarray, struct: type[object], device: str) -> DeviceArray:
    """Uploads the rows of a `table_dtype` table, at least one, as an array of structs."""
    array = DeviceArray(shape=len(table), dtype=struct, device=device)
    assign_table(array, table)
    return array
