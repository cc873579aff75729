"""Downloads of device arrays to the host.

A GPU writes directly to page-locked memory; it copies to other memory through a small staging buffer. Page-locked
memory is slow to allocate and scarce for the whole system, so a few blocks are reused. A frame holds its block as long
as something references the frame. While all blocks are held, images of further frames use ordinary memory.

A frame's images are first copied on the GPU, in a fraction of the time of a download. Each image is downloaded when it
is read, while the next frame may already render. Images that nobody reads are never downloaded.
"""

from __future__ import annotations

import threading
import weakref
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeVar, cast

import numpy as np
import numpy.typing as npt
import warp as wp

FRAME_BLOCKS_MAX = 3
"""Largest number of frames per renderer that hold page-locked memory, and of frames that hold a copy on the GPU.

Three suffice for one frame on display, one being saved and one being rendered."""

DeviceArray = Any
"""A Warp array, typed as Any: buffers.py defines the precise type, but cannot be imported here, because it imports
this module."""

Value = TypeVar("Value")


class Copies(Protocol):
    """Copies of several device arrays by name, on the host or still on the device."""

    def words(self, name: str, first: int = 0, count: int | None = None) -> npt.NDArray[np.float32]:
        """Returns ``count`` 32-bit words of array ``name`` from word ``first`` on; ``count`` None: all that remain."""
        ...

    def lazy(self, read: Callable[[], Value]) -> Value | Callable[[], Value]:
        """Calls ``read`` and returns its result; while the copies are on the device, returns ``read`` uncalled."""
        ...


class HostCopies:
    """Copies of device arrays that are already on the host."""

    def __init__(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        self._words = {name: values.reshape(-1).view(np.float32) for name, values in arrays.items()}

    def words(self, name: str, first: int = 0, count: int | None = None) -> npt.NDArray[np.float32]:
        """Returns ``count`` 32-bit words of array ``name`` from word ``first`` on; ``count`` None: all that remain."""
        return self._words[name][first : None if count is None else first + count]

    def lazy(self, read: Callable[[], Value]) -> Value | Callable[[], Value]:
        """Calls ``read`` and returns its result, because the copies are already on the host."""
        return read()


class DeviceCopies:
    """Copies of arrays in one block of device memory from the pool; each part is downloaded when it is read.

    Downloads run on a separate CUDA stream, so that any thread may read while another thread captures a graph.
    """

    def __init__(self, arrays: Mapping[str, DeviceArray], block: DeviceArray, downloads: Downloads) -> None:
        self._spans: dict[str, tuple[int, int]] = {}
        self._block, self._downloads = block, downloads
        first = 0
        for name, array in arrays.items():
            words = _words_of(array)
            self._spans[name] = first, words.size
            cast(Any, wp).copy(block, words, first, 0, words.size)
            first += words.size
        self._copied_event = None if block.device.is_cpu else block.device.stream.record_event()
        self._host: tuple[DeviceArray, npt.NDArray[np.float32]] | None = None

    def words(self, name: str, first: int = 0, count: int | None = None) -> npt.NDArray[np.float32]:
        """Downloads ``count`` 32-bit words of array ``name``, starting at word ``first``, and waits for the download.

        ``count`` None: all words from ``first`` on.
        """
        start, size = self._spans[name]
        begin, count = start + first, size - first if count is None else count
        if self._host is None:
            self._host = self._downloads.lend_host(self._block)
        if self._host is None:
            values = np.empty(count, np.float32)
            self._download(_as_array(values), 0, begin, count)
            return values
        target, values = self._host
        self._download(target, begin, begin, count)
        return values[begin : begin + count]

    def lazy(self, read: Callable[[], Value]) -> Value | Callable[[], Value]:
        """Returns ``read`` itself uncalled, so that words are downloaded when ``read`` is called."""
        return read

    def _download(self, target: DeviceArray, target_first: int, first: int, count: int) -> None:
        """Copies ``count`` words of the block, from ``first`` on, to host array ``target``, and waits for the copy."""
        stream = self._downloads.stream_of(self._block.device)
        if stream is not None:
            stream.wait_event(self._copied_event)
        cast(Any, wp).copy(target, self._block, target_first, first, count, stream=stream)
        if stream is not None:
            cast(Any, wp).synchronize_stream(stream)


class HostCopy:
    """Copy of a small device array in page-locked host memory, which the host reads without asking the device."""

    def __init__(self, source: DeviceArray) -> None:
        self.source = source
        pinned = not source.device.is_cpu  # without a GPU there is no page-locked memory
        self._host = cast(Any, wp).zeros(source.shape, dtype=source.dtype, device="cpu", pinned=pinned)
        self.values: npt.NDArray[Any] = self._host.numpy()
        """Values of the last `update` that the device has run; zeros before."""

    def update(self) -> None:
        """Copies the array once the device has run what was launched before."""
        cast(Any, wp).copy(self._host, self.source)


class HostHistory:
    """Latest copies of small float arrays in page-locked host memory, which the host reads long after they were made.

    Args:
        device: Warp device name.
        length: Number of copies that are kept.
        words: Largest size of an array.
    """

    def __init__(self, device: str, length: int, words: int) -> None:
        self.length, self._words = length, words
        pinned = device != "cpu"  # without a GPU there is no page-locked memory
        self._host = cast(Any, wp).zeros(length * words, dtype=wp.float32, device="cpu", pinned=pinned)
        self.values: npt.NDArray[np.float32] = self._host.numpy().reshape(length, words)
        """Copies as they are now, in the order of their numbers modulo ``length``; zeros before the first."""

    def add(self, number: int, source: DeviceArray) -> None:
        """Copies an array once the device has run what was launched before, in place of copy ``number - length``."""
        cast(Any, wp).copy(self._host, source, dest_offset=number % self.length * self._words, count=source.size)

    def __getitem__(self, number: int) -> npt.NDArray[np.float32]:
        """Returns copy ``number`` as it is now; if the device has not made it yet, it is that of an earlier number."""
        return self.values[number % self.length]


class Awaited:
    """Number that the device is still computing; a call waits for it, once.

    Args:
        wait: Waits until the device has computed the number.
        read: Returns the number after that.
    """

    def __init__(self, wait: Callable[[], None], read: Callable[[], int]) -> None:
        self._lock = threading.Lock()
        self._wait, self._read = wait, read
        self._value: int | None = None

    def __call__(self) -> int:
        """Returns the number."""
        with self._lock:
            if self._value is None:
                self._wait()
                self._value = self._read()
            return self._value


class Downloads:
    """Pool of host and device memory blocks for copies of frames, shared by all threads.

    A block returns to the pool when the object that holds it is finalised. A finalizer may run at any moment, even in a
    thread that is just taking a block from the pool. Finalizers therefore take no lock; they append the block to a
    deque, whose operations are atomic.

    Args:
        is_lazy: Copy frames on the device, and download images when they are read.
    """

    def __init__(self, *, is_lazy: bool = False) -> None:
        self.is_lazy = is_lazy
        self._lock = threading.Lock()
        self._returned: deque[tuple[str, DeviceArray]] = deque()
        self._free: dict[str, list[DeviceArray]] = {"host": [], "device": []}
        self._lent = {"host": 0, "device": 0}
        self._stream: Any = None
        self._block_bytes = 0

    @property
    def lent(self) -> dict[str, int]:
        """Number of memory blocks in use, by kind: page-locked host memory and device memory."""
        with self._lock:
            self._take_back()
            return dict(self._lent)

    @property
    def device_bytes(self) -> int:
        """Device memory of the pool in bytes, both in use and free."""
        with self._lock:
            self._take_back()
            return self._block_bytes * (len(self._free["device"]) + self._lent["device"])

    def copies(self, arrays: Mapping[str, DeviceArray]) -> Copies:
        """Copies arrays of 32-bit words as they are now; later writes do not change the copies."""
        block = self._lend_device(arrays) if self.is_lazy else None
        if block is None:
            return HostCopies({name: _numpy(array) for name, array in arrays.items()})
        copies = DeviceCopies(arrays, block, self)
        weakref.finalize(copies, self._returned.append, ("device", block)).atexit = False
        return copies

    def lend_host(self, source: DeviceArray) -> tuple[DeviceArray, npt.NDArray[np.float32]] | None:
        """Returns a page-locked block as large as an array; None if all blocks are in use.

        The block is in use until nothing references the returned arrays any more.
        """
        pinned = not source.device.is_cpu  # without a GPU there is no page-locked memory
        block = self._lend("host", source.size, lambda: _empty(source.size, device="cpu", pinned=pinned))
        if block is None:
            return None
        values = block.numpy()
        weakref.finalize(values, self._returned.append, ("host", block)).atexit = False
        return block, values

    def stream_of(self, device: wp.Device) -> Any:
        """Returns the stream for downloads from a device; None on the CPU."""
        if self._stream is None and not device.is_cpu:
            self._stream = cast(Any, wp).Stream(device)
        return self._stream

    def _lend_device(self, arrays: Mapping[str, DeviceArray]) -> DeviceArray | None:
        """Returns device memory for copies of arrays; None if all blocks are in use or the device is out of memory."""
        device = next(iter(arrays.values())).device
        size = sum(_words_of(array).size for array in arrays.values())
        try:
            block = self._lend("device", size, lambda: _empty(size, device=device))
        except RuntimeError:  # no room for a second frame
            return None
        self._block_bytes = self._block_bytes if block is None else block.capacity
        return block

    def _lend(self, kind: str, size: int, make: Callable[[], DeviceArray]) -> DeviceArray | None:
        """Takes a free block of ``size`` words from the pool, or makes one; None if too many of the kind are in use.

        Free blocks of other sizes are released.
        """
        with self._lock:
            self._take_back()
            if self._lent[kind] >= FRAME_BLOCKS_MAX:
                return None
            free = self._free[kind] = [block for block in self._free[kind] if block.size == size]
            block = free.pop() if free else make()
            self._lent[kind] += 1
            return block

    def _take_back(self) -> None:
        """Moves returned blocks to the free list; the caller holds the lock."""
        while self._returned:
            kind, block = self._returned.popleft()
            self._lent[kind] -= 1
            self._free[kind].append(block)


def _as_array(values: npt.NDArray[np.float32]) -> DeviceArray:
    """Returns a Warp array that shares a NumPy array's memory."""
    return cast(Any, wp).array(values, dtype=wp.float32, device="cpu", copy=False)


def _numpy(array: DeviceArray) -> npt.NDArray[Any]:
    """Copies an array to ordinary host memory."""
    values: npt.NDArray[Any] = array.numpy()
    return values.copy() if array.device.is_cpu else values


def _empty(size: int, **options: Any) -> DeviceArray:
    return cast(Any, wp).empty(size, dtype=wp.float32, **options)


def _words_of(array: DeviceArray) -> DeviceArray:
    """Returns a view of an array as 32-bit words."""
    words = array.size * wp.types.type_size_in_bytes(array.dtype) // 4
    return cast(Any, wp).array(ptr=array.ptr, dtype=wp.float32, shape=words, device=array.device, copy=False)
