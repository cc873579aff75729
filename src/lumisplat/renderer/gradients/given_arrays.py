"""Arrays that callers give, also those of other packages."""

from __future__ import annotations

from typing import Any

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray


def given_array(name: str, values: Any, shape: tuple[int, ...]) -> FloatArray:
    """A caller's array as C-contiguous float32, without a copy where that is possible.

    Raises:
        SceneError: It has another shape, or values that are not finite.
    """
    has_numpy = hasattr(values, "__array_interface__") or hasattr(values, "__array__")
    if hasattr(values, "__dlpack__") and not has_numpy:
        values = np.from_dlpack(values)
    array = np.ascontiguousarray(values, dtype=np.float32)
    if array.shape != shape:
        raise SceneError(f"{name} has shape {array.shape}, expected {shape}")
    bad = array.size - int(np.isfinite(array).sum())
    if bad:
        raise SceneError(f"{name}: {bad:,} of {array.size:,} values are not finite")
    return array
