"""Checks arrays from the user, converts them and makes them read-only; weighted quantiles."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from lumisplat.constants import TRANSFORM_MAX
from lumisplat.errors import SceneError

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int32]
Doubles = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

_DLPACK_CPU = 1
"""Device type of CPU memory: kDLCPU of dlpack.h."""

_Scalar = TypeVar("_Scalar", bound=np.generic)
_Float = TypeVar("_Float", bound=np.floating[Any])

_LAST_ROW = np.array((0.0, 0.0, 0.0, 1.0))
"""Last row of every affine 4 x 4 transform."""
_LAST_ROW_ERROR = 1e-6 + 1e-5 * _LAST_ROW
"""Largest accepted error of each entry of the last row of an affine transform."""

_UNIT_ERROR = 2e-15
"""A float64 vector counts as normalised, and is left unchanged, if its length differs from 1 by at most this."""


def float_array(name: str, values: npt.ArrayLike) -> FloatArray:
    """Returns ``values`` as a read-only, C-contiguous float32 array of finite numbers; see `finite_array`.

    Raises:
        SceneError: The values are not numbers, or some are NaN or infinite (the message counts them).
    """
    return finite_array(name, values, np.float32)


def to_floats(values: npt.ArrayLike, name: str = "array") -> FloatArray:
    """Converts a dataclass field to a float32 array; see `float_array`."""
    return float_array(name, values)


def to_floats_or_none(values: npt.ArrayLike | None, name: str = "array") -> FloatArray | None:
    """Converts a dataclass field to a float32 array, and leaves None as it is."""
    return None if values is None else float_array(name, values)


def finite_array(name: str, values: npt.ArrayLike, dtype: type[_Float]) -> npt.NDArray[_Float]:
    """Returns ``values`` as a read-only, C-contiguous array of finite numbers.

    Arrays that the caller can still write to are copied, because checked data must not change afterwards. Large arrays
    that are already read-only are used without a copy.

    Raises:
        SceneError: The values are not numbers, or some are NaN or infinite (the message counts them).
    """
    try:
        with np.errstate(over="ignore"):  # Overflow to infinity is reported below.
            array = read_only_array(values, dtype)
    except (TypeError, ValueError) as error:
        raise SceneError(f"{name} is not an array of numbers: {error}") from None
    invalid = array.size - np.count_nonzero(np.isfinite(array))
    if invalid:
        place = ", ".join(map(str, np.argwhere(~np.isfinite(array))[0]))
        raise SceneError(f"{name} has {invalid:,} non-finite values out of {array.size:,}, the first at [{place}]")
    return array


def host_array(values: Any) -> Any:
    """Returns an array of another package as a NumPy view through DLPack; everything else is returned unchanged.

    NumPy reads some foreign arrays by itself, such as PyTorch's CPU tensors; these are returned unchanged, too. Arrays
    on a GPU are copied, if their package supports it.

    Raises:
        SceneError: Neither NumPy nor the package can convert the array.
    """
    if not hasattr(values, "__dlpack__") or hasattr(values, "__array__") or hasattr(values, "__array_interface__"):
        return values  # NumPy arrays have __dlpack__, too
    is_on_host = int(values.__dlpack_device__()[0]) == _DLPACK_CPU
    try:
        read: npt.NDArray[Any] = np.from_dlpack(values) if is_on_host else np.from_dlpack(values, device="cpu")
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        problem = str(error).partition("\n")[0].rstrip(".")
        kind = type(values).__name__
        raise SceneError(f"an array of type {kind} cannot be read ({problem}): copy it to the CPU") from None
    return read


def finite_numbers(values: object, shape: tuple[int, ...]) -> npt.NDArray[np.float64] | None:
    """Returns ``values`` as a float64 array; None if they are not finite numbers or do not have the given shape."""
    try:
        numbers = np.array(host_array(values), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return numbers if numbers.shape == shape and np.isfinite(numbers).all() else None


def three_numbers(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Returns ``values`` as a float64 array of shape (3,), rounded to float32 as kernels receive them.

    Raises:
        SceneError: The values are not three finite numbers.
    """
    array = float_array(name, values)
    if array.shape != (3,):
        raise SceneError(f"{name} has shape {array.shape}, expected three numbers")
    return array.astype(np.float64)


def matrix_4x4(name: str, values: npt.ArrayLike | None) -> npt.NDArray[np.float64]:
    """Returns a read-only float64 affine transform; the identity for ``None``.

    Raises:
        SceneError: The matrix is not 4x4, not finite or singular; its last row is not (0, 0, 0, 1); or an entry of the
            matrix or of its inverse is too large for float32.
    """
    try:
        matrix = np.array(np.eye(4) if values is None else host_array(values), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SceneError(f"{name} is not a matrix of numbers: {error}") from None
    if matrix.shape != (4, 4):
        raise SceneError(f"{name} has shape {matrix.shape}, expected (4, 4)")
    if not np.isfinite(matrix).all():
        raise SceneError(f"{name} has non-finite values, expected 4x4 finite numbers")
    if (np.abs(matrix[3] - _LAST_ROW) > _LAST_ROW_ERROR).any():  # np.allclose takes longer than all other checks
        raise SceneError(f"{name} has last row {matrix[3].tolist()}, expected [0, 0, 0, 1]")
    scale = np.linalg.norm(matrix[:3, :3])
    if scale == 0.0 or abs(np.linalg.det(matrix[:3, :3] / scale)) < 1e-9:
        raise SceneError(f"{name} is singular, expected an invertible transform: no axis may be scaled to 0")
    # Kernels use the matrix and its inverse in float32.
    if max(np.abs(matrix).max(), np.abs(np.linalg.inv(matrix)).max()) > TRANSFORM_MAX:
        raise SceneError(f"{name} scales or moves by more than {TRANSFORM_MAX:g}, or its inverse does: use other units")
    matrix.flags.writeable = False
    return matrix


def box_text(low: npt.NDArray[Any], high: npt.NDArray[Any]) -> str:
    """Formats a box by its two corners: ``(-1, 0, 2.5)..(1, 3, 4)``."""
    low_text, high_text = (", ".join(f"{value:z.4g}" for value in corner) for corner in (low, high))
    return f"({low_text})..({high_text})"


def refuse_rows(name: str, problem: str, offenders: npt.NDArray[np.bool_]) -> None:
    """Raises a SceneError that counts the rows where ``offenders`` is True; does nothing if there are none."""
    count = np.count_nonzero(offenders)
    if count:
        raise SceneError(f"{name}: {count:,} of {offenders.size:,} are {problem} (first at index {offenders.argmax()})")


def refuse_outside_unit(name: str, values: FloatArray) -> None:
    """Raises a SceneError that counts the rows of ``values`` with a number outside 0..1; does nothing without any."""
    outside = (values < 0.0) | (values > 1.0)
    refuse_rows(name, "outside 0..1", np.asarray(outside.any(axis=tuple(range(1, values.ndim)))))


def normalise_rows(name: str, vectors: FloatArray) -> FloatArray:
    """Returns the rows scaled to unit length, read-only; rows that already have unit length are returned bit for bit.

    Raises:
        SceneError: Some rows have zero length.
    """
    # Divided by the largest component first: small but valid quaternions would underflow when squared.
    largest = np.abs(vectors).max(axis=1, keepdims=True)
    refuse_rows(name, "of zero length", largest[:, 0] == 0.0)
    scaled = vectors / largest
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    # Unit rows keep their bits: a subset, or a file that is read back, must not drift by one rounding each time.
    is_unit = np.abs(length * largest.astype(np.float64) - 1.0) < 1e-6
    unit = vectors if is_unit.all() else np.where(is_unit, vectors, scaled / length)
    unit.flags.writeable = False
    return unit


def unit_vector(vector: Doubles) -> Doubles:
    """Normalises a vector of any length above 0; returns a vector of unit length, up to rounding, bit for bit."""
    length = np.linalg.norm(vector)
    return vector if abs(length - 1.0) < _UNIT_ERROR else vector / length


def read_only_array(values: npt.ArrayLike, dtype: type[_Scalar]) -> npt.NDArray[_Scalar]:
    """Returns ``values`` as a read-only, C-contiguous array; copies them unless they are such an array already."""
    # A view of another package's memory is copied, even if NumPy cannot write to it, because the other package can.
    is_fixed = isinstance(values, np.ndarray) and not values.flags.writeable
    values = host_array(values)
    array = np.ascontiguousarray(values, dtype=dtype) if is_fixed else np.array(values, dtype=dtype, order="C")
    array.flags.writeable = False
    return array


def read_only_view(values: npt.NDArray[_Scalar]) -> npt.NDArray[_Scalar]:
    """Returns a read-only view of an array that nobody else writes to; scene classes use it without a copy."""
    view = values.view()
    view.flags.writeable = False
    return view


def weighted_quantile(values: Doubles, weights: Doubles, share: float) -> float:
    """Returns the value below which a given fraction of the total weight lies, interpolated linearly between values.

    With equal weights, the result is NumPy's quantile.

    Args:
        values: N values, shape (N,).
        weights: Weights of the values, non-negative, at least one of them positive, shape (N,); values of weight 0 are
            ignored.
        share: Fraction 0..1; 0 gives the smallest value, 1 the largest.
    """
    is_weighted = weights > 0.0
    order = np.argsort(values[is_weighted], kind="stable")
    ordered, counted = values[is_weighted][order], weights[is_weighted][order]
    below: Doubles = np.cumsum(counted) - 0.5 * counted
    return float(np.interp(float(below[0] + share * (below[-1] - below[0])), below, ordered))
