"""Parallel primitives of Warp's library, checked and with types: prefix sums, sorts and copies of device arrays.

Sums and sorts of the library act on the CUDA context that is current in the thread, whichever device their arrays are
on, and its sorts return no status: where one finds no memory for its scratch space it leaves a message, and the keys
unsorted. Both are seen to here, and nowhere else.
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
    """Writes the sums of ``values`` up to each element, ``inclusive`` of it or not.

    Raises:
        DeviceError: The device has no room for scratch space, or has failed before.
    """
    with _checked("sum", values):
        wp.utils.array_scan(values, sums, inclusive=inclusive)


def sort_pairs(keys: DeviceArray, values: DeviceArray, count: int, *, bits: int | None = None) -> None:
    """Sorts the first ``count`` keys ascending, and their values with them; the sort is stable.

    Args:
        keys: Twice as many elements as are sorted; the second half is scratch space.
        values: As many as keys.
        count: Elements to sort.
        bits: Low bits of the keys that count; None: all.

    Raises:
        DeviceError: The device has no room for scratch space, or has failed before.
    """
    try:
        _sort_pairs(keys, values, count, bits)
    except DeviceError:
        # The first sort after an allocation has failed, somewhere else, fails with it, before it has begun (H200).
        _sort_pairs(keys, values, count, bits)


def _sort_pairs(keys: DeviceArray, values: DeviceArray, count: int, bits: int | None) -> None:
    with _checked("sort", keys):
        wp.utils.radix_sort_pairs(keys, values, count, end_bit=bits)


def copy_elements(source: DeviceArray, target: DeviceArray, count: int) -> None:
    """Copies the first ``count`` elements."""
    wp.copy(target, source, count=count)


@contextmanager
def _checked(verb: str, array: DeviceArray) -> Generator[None]:
    """Makes the array's device the current one for a call of the library; its failure is a DeviceError."""
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
    """The memory that holds the last message of Warp's library: it is never emptied there."""
    library: Any = cast(Any, wp)._src.context.runtime.core
    address = ctypes.CFUNCTYPE(ctypes.c_void_p)(("wp_get_error_string", library))()
    return (ctypes.c_char * 4096).from_address(address)
