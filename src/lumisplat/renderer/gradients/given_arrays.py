"""Arrays that callers give, also those of other packages."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import warp as wp

from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray, host_array

DLPACK_CUDA = 2
"""kDLCUDA of dlpack.h."""


def given_array(name: str, values: Any, shape: tuple[int, ...]) -> FloatArray:
    """A caller's array as C-contiguous float32, without a copy where that is possible; those of GPUs are downloaded.

    Raises:
        SceneError: It cannot be read, has another shape, or values that are not finite.
    """
    try:
        array = _read(values)
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        problem = str(error).partition("\n")[0].rstrip(".")
        raise SceneError(
            f"{name} cannot be read as an array: {problem}; expected numbers, and a tensor that has gradients detached"
        ) from None
    if array.shape != shape:
        raise SceneError(f"{name} has shape {array.shape}, expected {shape}")
    bad = array.size - int(np.isfinite(array).sum())
    if bad:
        raise SceneError(f"{name}: {bad:,} of {array.size:,} values are not finite")
    return array


def _read(values: Any) -> FloatArray:
    """As ``given_array``, of any shape.

    Raises:
        BufferError, RuntimeError, TypeError, ValueError: Its package refuses, or it is no array.
    """
    if _is_on_gpu(values):
        there = cast(Any, wp).from_dlpack(values)
        values = there.numpy()
    return np.ascontiguousarray(host_array(values), dtype=np.float32)


def _is_on_gpu(values: Any) -> bool:
    """Whether an array says, by DLPack, that NumPy cannot read its memory."""
    device = getattr(values, "__dlpack_device__", None)
    return device is not None and int(device()[0]) == DLPACK_CUDA
