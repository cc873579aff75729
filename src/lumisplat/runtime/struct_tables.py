"""Tables of structs: filled row by row in NumPy, or uploaded where fields are arrays themselves."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import warp as wp


def table_dtype(struct: Any) -> np.dtype[np.void]:
    """NumPy's view of a Warp struct, to fill tables of it row by row."""
    return np.dtype(struct.numpy_dtype())


def upload_structs(rows: list[Any], struct: Any, device: str) -> Any:
    """An array of structs, some of whose fields may be arrays, which the caller must keep.

    Bytes are copied as they are: Warp's own conversion of such structs takes milliseconds.
    """
    kind = type(rows[0].__ctype__())
    packed = (kind * len(rows))(*(row.__ctype__() for row in rows))
    host = wp.array(ptr=ctypes.addressof(packed), dtype=struct, shape=len(rows), device="cpu", copy=False)
    return wp.clone(host, device=device)
