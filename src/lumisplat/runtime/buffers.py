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
"""Size in bytes up to which an array is allocated without querying how much memory is free.

The first frame allocates 150 arrays, most of them smaller than this, and each query takes 0.3 ms (measured in a
container).
"""

Struct = TypeVar("Struct")


if TYPE_CHECKING:

    class DeviceArray(wp.array[Any]):
        """A Warp array with type annotations for host code; Warp leaves most members of its arrays unannotated."""

        shape: tuple[int, ...]
        ptr: int
        capacity: int
        keep_alive: object
        """Objects that must live as long as the array, because its elements point to them."""
        device: wp.Device

        def __getitem__(self, key: slice) -> DeviceArray:
            """Returns a view of the elements that a slice selects."""
            ...

        def reshape(self, shape: int | tuple[int, ...]) -> DeviceArray:
            """Returns a view of the array with another shape."""
            ...

        def assign(self, src: npt.NDArray[Any] | wp.array[Any]) -> None:
            """Copies all elements of a host array or another device array into this array."""
            ...

        def fill_(self, value: object) -> None:
            """Sets all elements to one value."""
            ...

        def numpy(self, *, _suppress_bfloat16_warning: bool = False) -> npt.NDArray[Any]:
            """Returns the elements on the host; for CPU arrays, a view of the same memory."""
            ...

else:
    DeviceArray = wp.array


def device_array(array: wp.array[Any]) -> DeviceArray:
    """Casts a struct's array field to the type that host code uses; at run time, returns the array unchanged."""
    return cast(DeviceArray, array)


def assign_table(array: DeviceArray, table: npt.NDArray[np.void]) -> None:
    """Copies a NumPy table into an array of structs byte by byte, ten times faster than Warp's own conversion."""
    assert table.flags.c_contiguous and table.dtype.itemsize == wp.types.type_size_in_bytes(array.dtype)
    array.assign(DeviceArray(ptr=table.ctypes.data, dtype=array.dtype, shape=len(table), device="cpu", copy=False))


def rows_of(structs: Sequence[object]) -> npt.NDArray[np.void]:
    """Packs structs into the rows of a table, byte by byte; array fields become the addresses that kernels use."""
    instances: Any = structs
    data = b"".join(bytes(row.__ctype__()) for row in instances)
    return np.frombuffer(data, dtype=f"V{len(data) // len(structs)}")


def bytes_of(*arrays: wp.array[Any]) -> int:
    """Returns the total memory of arrays in bytes."""
    return sum(device_array(array).capacity for array in arrays)


def grown_capacity(count: int) -> int:
    """Rounds a number of elements up by at most a quarter, so that small changes need no new allocation."""
    step = 1 << max(10, count.bit_length() - 3)
    return -(-count // step) * step


class Buffers:
    """Device arrays by name; each is allocated once and reused.

    A request that is no larger than an earlier one with the same name returns a view of the same memory. Nothing is
    allocated after the first frame of a size.

    Args:
        device: Warp device name.
    """

    def __init__(self, device: str) -> None:
        self._device = device
        self._arrays: dict[str, DeviceArray] = {}
        self._views: dict[tuple[str, tuple[int, ...]], DeviceArray] = {}
        self.downloads = Downloads(is_lazy=device != "cpu")
        """Memory pool for copying arrays to the host."""
        self._rows: dict[str, bytes] = {}
        self.allocations = 0
        """Number of allocations so far; if it has changed since a CUDA graph was captured, the graph must be captured
        again."""

    def get(self, name: str, dtype: type[object], shape: int | tuple[int, ...]) -> DeviceArray:
        """Returns the array called ``name``, with elements of ``dtype`` in ``shape``; its contents are undefined.

        Raises:
            DeviceError: The device is out of memory.
        """
        shape = (shape,) if isinstance(shape, int) else shape
        view = self._views.get((name, shape))
        if view is not None:
            return view
        size = math.prod(shape)
        array = self._arrays.get(name)
        if array is None or array.size < size:
            array = self._allocate(name, dtype, max(size, 1))
        view = array[:size].reshape(shape) if size else array[:size]
        self._views[(name, shape)] = view
        return view

    def upload(self, name: str, dtype: type[object], values: npt.NDArray[Any]) -> DeviceArray:
        """Returns an array with a copy of ``values``, one element per row.

        Raises:
            DeviceError: The device is out of memory.
        """
        array = self.get(name, dtype, len(values))
        if len(values) and values.dtype.kind == "V":
            assign_table(array, values)
        elif len(values):
            array.assign(values)
        return array

    def table(self, name: str, struct: type[object], rows: Sequence[object]) -> DeviceArray:
        """Returns an array of structs; fields of the structs may be arrays of this `Buffers` object.

        The array is written only if ``rows`` differ from those of the last call. A pass that is captured as a CUDA
        graph may therefore call this method in every frame: nothing else writes the array between two replays.
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
        """Returns several arrays of ``count`` elements in one block of memory, so that one copy downloads them all.

        Args:
            name: Name of the block.
            fields: Name, dtype and element size (in 32-bit words) of each array.
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
            arrays[field].keep_alive = block
            first += count * words
        return block, arrays

    def struct(self, name: str, struct_type: type[Struct], count: int, without: Collection[str] = ()) -> Struct:
        """Returns a struct whose array fields have ``count`` undefined elements, in buffers called ``name.field``.

        Fields named in ``without`` get no array; in kernels, such a field is False in a condition.
        """
        struct: Any = struct_type
        filled = struct_type()
        for field, variable in struct.vars.items():
            if field not in without:
                setattr(filled, field, self.get(f"{name}.{field}", variable.type.dtype, count))
        return filled

    @property
    def bytes(self) -> int:
        """Device memory of all arrays in bytes."""
        return sum(array.capacity for array in self._arrays.values()) + self.downloads.device_bytes

    def _allocate(self, name: str, dtype: type[object], size: int) -> DeviceArray:
        self._rows.pop(name, None)
        self._arrays.pop(name, None)  # freed before its successor is allocated, so that both never exist together
        self._views = {key: view for key, view in self._views.items() if key[0] != name}
        needed = size * wp.types.type_size_in_bytes(dtype)
        limit = usable_memory() if self._device == "cpu" and needed >= UNCHECKED_BYTES else None
        if limit is not None and self.bytes + needed > limit:
            # Linux would overcommit the memory, and kill the process when it writes there.
            raise DeviceError(
                f"cpu has too little memory for {needed / 2**30:,.1f} GiB of '{name}': use fewer pixels or Gaussians"
            )
        try:
            array = DeviceArray(shape=size, dtype=dtype, device=self._device)
        except (RuntimeError, ValueError) as error:  # Warp raises ValueError for sizes beyond its index range
            raise DeviceError(f"{self._device} cannot allocate {size:,} elements for '{name}': {error}") from None
        self._arrays[name] = array
        self.allocations += 1
        return array
