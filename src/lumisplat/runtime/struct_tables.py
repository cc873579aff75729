"""Tables of structs: filled row by row in NumPy, or uploaded where fields are arrays themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp


def table_dtype(struct: Any) -> np.dtype[np.void]:
    """NumPy's view of a Warp struct, to fill tables of it row by row."""
    return np.dtype(struct.numpy_dtype())


def upload_structs(rows: list[Any], struct: Any, device: str) -> Any:
    """An array of structs, some of whose fields may be arrays."""
    return wp.array(rows, dtype=struct, device=device)
