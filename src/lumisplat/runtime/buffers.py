"""Named device arrays that only grow, so that frames of one size allocate them once."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.errors import DeviceError
from lumisplat.memory import usable_memory
from lumisplat.runtime.downloads import Downloads

UNCHECKED_BYTES = 2**20
"""Size of an array, bytes, below which the limits of memory are not read before it is allocated.

A first frame allocates 150 arrays, most of them smaller, and reading the limits takes 0.3 ms (measured in a container).
"""

Noun = TypeVar("Noun")


if TYPE_CHECKING:

    class DeviceArray(wp.array[Any]):
        """A Warp array as host code uses it, for type checkers: Warp leaves most of its members without annotations."""

        shape: tuple[int, ...]
        ptr: int
        capacity: int
        kept: object
        """What lives at least as long as the array does, because its elements point there."""
        device: wp.Device

        def __getitem__(self, key: slice) -> DeviceArray:
            """A view of some elements."""
            ...

        def reshape(self, shape: int | tuple[int, ...]) -> DeviceArray:
            """A view of another shape."""
            ...

        def assign(self, src: npt.NDArray[Any] | wp.array[Any]) -> None:
            """Copies as many elements, from the host or from another array."""
            ...

        def fill_(self, value: object) -> None:
            """Sets all elements."""
            ...

        def numpy(self, *, _suppress_bfloat16_warning: bool = False) -> npt.NDArray[Any]:
            """The elements on the host; of an array on the CPU, the same memory."""
            ...

else:
    DeviceArray = wp.array


def device_array(array: wp.array[Any]) -> DeviceArray:
    """The array itself: for type checkers, the field of a struct as host code uses it."""
    return cast(DeviceArray, array)


def assign_table(array: DeviceArray, table: npt.NDArray[np.void]) -> None:
    """Sets all elements of an array of structs, byte by byte: Warp's own conversion takes ten times as long."""
    assert table.flags.c_contiguous and table.dtype.itemsize == wp.types.type_size_in_bytes(array.dtype)
    array.assign(DeviceArray(ptr=table.ctypes.data, dtype=array.dtype, shape=len(table), device="cpu", copy=False))


def rows_of(structs: Sequence[object]) -> npt.NDArray[np.void]:
    """Structs as the rows of a table, byte by byte; arrays among their fields as the addresses that kernels follow."""
    instances: Any = structs
    data = b"".join(bytes(row.__ctype__()) for row in instances)
    return np.frombuffer(data, dtype=f"V{len(data) // len(structs)}")


def bytes_of(*arrays: wp.array[Any]) -> int:
    """Memory of arrays, bytes."""
    return sum(device_array(array).capacity for array in arrays)


def grown_capacity(count: int) -> int:
    """Capacity for ``count`` elements, in steps of up to a quarter, so that small changes do not reallocate."""
    step = 1 << max(10, count.bit_length() - 3)
    return -(-count // step) * step


class Buffers:
    """Arrays by name.

    A request no larger than an earlier one returns a view of the same memory: no allocation after the first frame of a
    size.

    Args:
        device: Warp device name.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._arrays: dict[str, DeviceArray] = {}
        self._views: dict[tuple[str, tuple[int, ...]], DeviceArray] = {}
        self.downloads = Downloads(is_lazy=device != "cpu")
        """Copies arrays to the host."""
        self._rows: dict[str, bytes] = {}
        self.allocations = 0
        """How often memory was allocated: captured graphs are stale after a change."""

    def get(self, name: str, dtype: type[object], shape: int | tuple[int, ...]) -> DeviceArray:
        """An array of ``shape`` with undefined contents.

        Raises:
            DeviceError: The device is out of memory.
        """
        shape = (shape,) if isinstance(shape, int) else shape
        view = self._views.get((name, shape))
        if view is not None:
            return view
        size = math.prod(shape)
        held = self._arrays.get(name)
        if held is None or held.size < size:
            held = self._allocate(name, dtype, max(size, 1))
        view = held[:size].reshape(shape) if size else held[:size]
        self._views[(name, shape)] = view
        return view

    def upload(self, name: str, dtype: type[object], values: npt.NDArray[Any]) -> DeviceArray:
        """An array with a copy of ``values``, one element a row.

        Raises:
            DeviceError: The device is out of memory.
        """
        array = self.get(name, dtype, len(values))
        if values.dtype.kind == "V":
            assign_table(array, values)
        elif len(values):
            array.assign(values)
        return array

    def table(self, name: str, struct: type[object], rows: Sequence[object]) -> DeviceArray:
        """An array of structs whose fields may be arrays of these buffers; written only if it has other rows.

        So passes may be captured that write it each time: nothing else than they may write it between two replays.
        """
        data = rows_of(rows)
        array = self.get(name, struct, len(rows))
        written = data.tobytes()
        if self._rows.get(name) != written:
            assign_table(array, data)
            self._rows[name] = written
        return array

    def split(
        self, name: str, fields: Sequence[tuple[str, type[object], int]], count: int
    ) -> tuple[DeviceArray, dict[str, DeviceArray]]:
        """Several arrays of ``count`` elements in one block of memory, so that one copy downloads them all.

        Args:
            name: Name of the block.
            fields: Name, dtype and size in 32-bit words of each array's elements.
            count: Number of elements of each array.

        Returns:
            The block as float32, field after field, and the arrays by name.
        """
        block = self.get(name, wp.float32, count * sum(words for _, _, words in fields))
        arrays: dict[str, DeviceArray] = {}
        first = 0
        for field, dtype, words in fields:
            arrays[field] = DeviceArray(
                ptr=block.ptr + 4 * first, dtype=dtype, shape=count, device=self._device, copy=False
            )
            arrays[field].kept = block
            first += count * words
        return block, arrays

    def struct(self, name: str, noun: type[Noun], count: int, without: Collection[str] = ()) -> Noun:
        """A struct whose fields are arrays of ``count`` elements with undefined contents, named ``name.field``.

        Fields named in ``without`` get no array, and are false in kernels.
        """
        struct: Any = noun
        filled = noun()
        for field, variable in struct.vars.items():
            if field not in without:
                setattr(filled, field, self.get(f"{name}.{field}", variable.type.dtype, count))
        return filled

    @property
    def bytes(self) -> int:
        """Memory held on the device, bytes."""
        return sum(array.capacity for array in self._arrays.values()) + self.downloads.device_bytes

    def _allocate(self, name: str, dtype: type[object], size: int) -> DeviceArray:
        self._rows.pop(name, None)
        self._arrays.pop(name, None)  # freed before its successor is allocated: the peak is one of them, not both
        self._views = {key: view for key, view in self._views.items() if key[0] != name}
        needed = size * wp.types.type_size_in_bytes(dtype)
        there = usable_memory() if self._device == "cpu" and needed >= UNCHECKED_BYTES else None
        if there is not None and self.bytes + needed > there:
            # The system would overcommit the memory, and kill the process once it is written.
            raise DeviceError(
                f"cpu has no room for {needed / 2**30:,.1f} GiB of '{name}': use fewer pixels or Gaussians"
            )
        try:
            array = DeviceArray(shape=size, dtype=dtype, device=self._device)
        except (RuntimeError, ValueError) as error:  # Warp refuses sizes beyond its index range with the latter
            raise DeviceError(f"{self._device} cannot allocate {size:,} elements for '{name}': {error}") from None
        self._arrays[name] = array
        self.allocations += 1
        return array
