"""Arrays at the door: converted, checked, kept where nobody can change them. Shared by the scene dataclasses."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.constants import TRANSFORM_MAX
from lumisplat.errors import SceneError

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int32]

FLOAT32_MAX = float(np.finfo(np.float32).max)
"""Largest number that a kernel can be given."""


def float_array(name: str, values: npt.ArrayLike) -> FloatArray:
    """Returns ``values`` as a read-only, C-contiguous float32 array of finite numbers.

    What the caller can still write to is copied: data that was checked must not change afterwards. Large arrays that
    are made read-only first are taken as they are.

    Raises:
        SceneError: The values are not numbers, or some are NaN or infinite (the message counts them).
    """
    try:
        with np.errstate(over="ignore"):  # Overflow to infinity is reported below.
            array = kept(values, np.float32)
    except (TypeError, ValueError) as error:
        raise SceneError(f"{name} is not an array of numbers: {error}") from None
    invalid = array.size - np.count_nonzero(np.isfinite(array))
    if invalid:
        raise SceneError(f"{name} has {invalid:,} non-finite values out of {array.size:,}")
    return array


def matrix_4x4(name: str, values: npt.ArrayLike | None) -> npt.NDArray[np.float64]:
    """Returns a read-only float64 affine transform, the identity for ``None``.

    Raises:
        SceneError: Not 4x4, not finite, the last row is not (0, 0, 0, 1), singular, or out of float32's reach.
    """
    try:
        matrix = np.array(np.eye(4) if values is None else values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SceneError(f"{name} is not a matrix of numbers: {error}") from None
    if matrix.shape != (4, 4):
        raise SceneError(f"{name} has shape {matrix.shape}, expected (4, 4)")
    if not np.isfinite(matrix).all():
        raise SceneError(f"{name} has non-finite values")
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=1e-6):
        raise SceneError(f"{name} has last row {matrix[3].tolist()}, expected [0, 0, 0, 1]")
    scale = np.linalg.norm(matrix[:3, :3])
    if scale == 0.0 or abs(np.linalg.det(matrix[:3, :3] / scale)) < 1e-9:
        raise SceneError(f"{name} is singular")
    # Kernels take the matrix and its inverse in float32.
    if max(np.abs(matrix).max(), np.abs(np.linalg.inv(matrix)).max()) > TRANSFORM_MAX:
        raise SceneError(f"{name} scales or moves by more than {TRANSFORM_MAX:g}, or by as much in its inverse")
    matrix.flags.writeable = False
    return matrix


def refuse_rows(name: str, problem: str, offenders: npt.NDArray[np.bool_]) -> None:
    """Raises a `SceneError` that counts the rows where ``offenders`` is true, if there are any."""
    count = np.count_nonzero(offenders)
    if count:
        raise SceneError(f"{name}: {count:,} of {offenders.size:,} are {problem} (first at index {offenders.argmax()})")


def refuse_outside_unit(name: str, values: FloatArray) -> None:
    """Raises a `SceneError` where a row of ``values`` leaves 0..1."""
    outside = (values < 0.0) | (values > 1.0)
    refuse_rows(name, "outside 0..1", np.asarray(outside.any(axis=tuple(range(1, values.ndim)))))


def handed_over(values: npt.NDArray) -> npt.NDArray:
    """A read-only view of ``values``, which nobody else keeps: scene classes then take it as it is, without a copy."""
    view = values.view()
    view.flags.writeable = False
    return view


def normalised(name: str, vectors: FloatArray) -> FloatArray:
    """Rows of unit length, read-only; those that have it already are kept to the bit.

    Raises:
        SceneError: Some are of zero length.
    """
    # Scaled by the largest component first: tiny but valid quaternions would underflow when squared.
    largest = np.abs(vectors).max(axis=1, keepdims=True)
    refuse_rows(name, "of zero length", largest[:, 0] == 0.0)
    scaled = vectors / largest
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    # Unit ones stay as they are: a subset, or a file read back, must not drift by a rounding each time.
    already = np.abs(length * largest.astype(np.float64) - 1.0) < 1e-6
    unit = vectors if already.all() else np.where(already, vectors, scaled / length)
    unit.flags.writeable = False
    return unit


def kept(values: npt.ArrayLike, dtype: npt.DTypeLike) -> npt.NDArray:
    """A read-only, C-contiguous array of ``values``: themselves if they are read-only, else a copy."""
    fixed = isinstance(values, np.ndarray) and not values.flags.writeable
    array = np.ascontiguousarray(values, dtype=dtype) if fixed else np.array(values, dtype=dtype, order="C")
    array.flags.writeable = False
    return array
