"""Checked wrappers of Warp's parallel primitives: prefix sums, sorts and copies of device arrays.

Warp's sums and sorts use the CUDA context that is current in the thread, whichever device their arrays are on. Its
sorts return no status: if there is no memory for scratch space, a sort leaves the keys unsorted and only stores an
error message. The functions here set the context and raise errors.
"""

# Warp leaves the elements of their arrays without annotations, and its messages without a public name.
# pyright: reportUnknownMemberType=false

from __future__ import annotations

import ctypes
from collections.abc import Generator
from contextlib import contextmanager
from functools import cache
from typing import Any, cast

import warp as wp

from lumisplat.errors import DeviceError
from lumisplat.runtime.buffers import DeviceArray


def prefix_sum(values: DeviceArray, sums: DeviceArray, *, inclusive: bool) -> None:
    """Writes the inclusive or exclusive prefix sums of ``values`` to ``sums``.

    Raises:
        DeviceError: The device has no memory for scratch space, or an earlier operation on it has failed.
    """
    with _checked("sum", values):
        wp.utils.array_scan(values, sums, inclusive=inclusive)


def sort_pairs(keys: DeviceArray, values: DeviceArray, count: int, *, bits: int | None = None) -> None:
    """Sorts the first ``count`` keys in ascending order, and their values with them; the sort is stable.

    Args:
        keys: Keys, an array of at least 2 ``count`` elements; the second half is scratch space.
        values: Values, an array as large as ``keys``.
        count: Number of elements to sort.
        bits: Number of low bits of the keys to sort by; None: all.

    Raises:
        DeviceError: The device has no memory for scratch space, or an earlier operation on it has failed.
    """
    try:
        _sort_pairs(keys, values, count, bits)
    except DeviceError:
        # The first sort after a failed allocation elsewhere reports that failure without sorting (seen on an H200).
        _sort_pairs(keys, values, count, bits)


def _sort_pairs(keys: DeviceArray, values: DeviceArray, count: int, bits: int | None) -> None:
    with _checked("sort", keys):
        wp.utils.radix_sort_pairs(keys, values, count, end_bit=bits)


def copy_elements(source: DeviceArray, target: DeviceArray, count: int) -> None:
    """Copies the first ``count`` elements of ``source`` to ``target``."""
    wp.copy(target, source, count=count)


@contextmanager
def _checked(verb: str, array: DeviceArray) -> Generator[None]:
    """Makes the array's device current during a library call, and raises DeviceError if the call fails."""
    message = error_message()
    message.value = b""
    problem = ""
    with wp.ScopedDevice(array.device):
        try:
            yield
        except RuntimeError as error:
            problem = str(error)
    problem = message.value.decode(errors="replace") or problem
    if problem:
        reason = " ".join(problem.split())
        raise DeviceError(f"{array.device} cannot {verb} {array.size:,} elements: {reason}") from None


@cache
def error_message() -> ctypes.Array[ctypes.c_char]:
    """Returns the buffer that holds the Warp library's last error message; the library never clears the buffer."""
    library: Any = cast(Any, wp)._src.context.runtime.core
    address = ctypes.CFUNCTYPE(ctypes.c_void_p)(("wp_get_error_string", library))()
    return (ctypes.c_char * 4096).from_address(address)
