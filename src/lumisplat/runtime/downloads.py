"""Copies of device arrays on the host.

A GPU writes to page-locked memory directly, and to other memory through small pieces that the processor copies. Such
memory is slow to get and taken from all programs, so that a few blocks are lent in turns: who holds a frame holds its
block, and a program that keeps many frames gets the others in ordinary memory.

What a frame shows is copied on the GPU first, which takes a fraction of the time of a download, and downloaded image by
image when it is read: the next frame may then be drawn, and what nobody reads is never downloaded.
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
"""Frames of a renderer that may hold page-locked memory, and as many that may hold a copy on the GPU, at a time: one
that is shown, one saved, one to come."""

DeviceArray = Any
"""A Warp array; its type for host code is declared where buffers are, which hold this."""

Value = TypeVar("Value")


class Copies(Protocol):
    """Copies of several arrays, by name."""

    def words(self, name: str, first: int = 0, count: int | None = None) -> npt.NDArray[np.float32]:
        """``count`` of the 32-bit words of an array, from the ``first`` on; None: all that follow."""
        ...

    def give(self, read: Callable[[], Value]) -> Value | Callable[[], Value]:
        """What ``read`` returns; or itself, if words are better read when somebody needs them."""
        ...


class CopiesNow:
    """Copies that are on the host already."""

    def __init__(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        self._words = {name: values.reshape(-1).view(np.float32) for name, values in arrays.items()}

    def words(self, name: str, first: int = 0, count: int | None = None) -> npt.NDArray[np.float32]:
        """As in `Copies`."""
        return self._words[name][first : None if count is None else first + count]

    def give(self, read: Callable[[], Value]) -> Value | Callable[[], Value]:
        """What ``read`` returns."""
        return read()


class CopiesLater:
    """Copies on the device, in one block that is lent, of which parts are downloaded when they are read.

    They are downloaded on a stream of their own: any thread may read them, also while another one captures a graph.
    """

    def __init__(self, arrays: Mapping[str, DeviceArray], block: DeviceArray, downloads: Downloads) -> None:
        self._place: dict[str, tuple[int, int]] = {}
        self._block, self._downloads = block, downloads
        first = 0
        for name, array in arrays.items():
            words = _words_of(array)
            self._place[name] = first, words.size
            cast(Any, wp).copy(block, words, first, 0, words.size)
            first += words.size
        self._is_copied = None if block.device.is_cpu else block.device.stream.record_event()
        self._host: tuple[DeviceArray, npt.NDArray[np.float32]] | None = None

    def words(self, name: str, first: int = 0, count: int | None = None) -> npt.NDArray[np.float32]:
        """As in `Copies`; waits for the device."""
        start, size = self._place[name]
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

    def give(self, read: Callable[[], Value]) -> Value | Callable[[], Value]:
        """``read`` itself."""
        return read

    def _download(self, target: DeviceArray, target_first: int, first: int, count: int) -> None:
        """Copies words to the host, and waits for them."""
        stream = self._downloads.stream_of(self._block.device)
        if stream is not None:
            stream.wait_event(self._is_copied)
        cast(Any, wp).copy(target, self._block, target_first, first, count, stream=stream)
        if stream is not None:
            cast(Any, wp).synchronize_stream(stream)


class Downloads:
    """Lends memory to what is copied to the host, to any thread.

    Memory comes back when what holds it is finalised, on any thread and at any moment, also while that thread lends:
    finalizers therefore take no lock, and only note in a deque, whose operations are atomic, what has come back.

    Args:
        is_lazy: Frames are copied on the device, and downloaded when they are read.
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
        """Blocks whose contents somebody still holds, in each kind of memory."""
        with self._lock:
            self._take_back()
            return dict(self._lent)

    @property
    def device_bytes(self) -> int:
        """Memory of frames that wait on the device, or have waited there, bytes."""
        with self._lock:
            self._take_back()
            return self._block_bytes * (len(self._free["device"]) + self._lent["device"])

    def copies(self, arrays: Mapping[str, DeviceArray]) -> Copies:
        """Copies of arrays of 32-bit words, as they are now: nothing else writes to them."""
        block = self._lend_device(arrays) if self.is_lazy else None
        if block is None:
            return CopiesNow({name: _numpy(array) for name, array in arrays.items()})
        copies = CopiesLater(arrays, block, self)
        weakref.finalize(copies, self._returned.append, ("device", block)).atexit = False
        return copies

    def lend_host(self, source: DeviceArray) -> tuple[DeviceArray, npt.NDArray[np.float32]] | None:
        """Page-locked memory as large as an array, lent until all views of it are gone; None: others hold it."""
        pinned = not source.device.is_cpu  # a machine without a GPU has no page-locked memory to lend
        block = self._lend("host", source.size, lambda: _empty(source.size, device="cpu", pinned=pinned))
        if block is None:
            return None
        values = block.numpy()
        weakref.finalize(values, self._returned.append, ("host", block)).atexit = False
        return block, values

    def stream_of(self, device: wp.Device) -> Any:
        """The stream on which a device downloads; None on the CPU."""
        if self._stream is None and not device.is_cpu:
            self._stream = cast(Any, wp).Stream(device)
        return self._stream

    def _lend_device(self, arrays: Mapping[str, DeviceArray]) -> DeviceArray | None:
        """Memory for copies of arrays; None: other frames hold it, or there is none."""
        device = next(iter(arrays.values())).device
        size = sum(_words_of(array).size for array in arrays.values())
        try:
            block = self._lend("device", size, lambda: _empty(size, device=device))
        except RuntimeError:  # there is no room for a second frame
            return None
        self._block_bytes = self._block_bytes if block is None else block.capacity
        return block

    def _lend(self, kind: str, size: int, make: Callable[[], DeviceArray]) -> DeviceArray | None:
        """A block; those of other sizes are given up, as images of one size follow each other."""
        with self._lock:
            self._take_back()
            if self._lent[kind] >= FRAME_BLOCKS_MAX:
                return None
            free = self._free[kind] = [block for block in self._free[kind] if block.size == size]
            block = free.pop() if free else make()
            self._lent[kind] += 1
            return block

    def _take_back(self) -> None:
        """Counts what has come back as free; the caller holds the lock."""
        while self._returned:
            kind, block = self._returned.popleft()
            self._lent[kind] -= 1
            self._free[kind].append(block)


def _as_array(values: npt.NDArray[np.float32]) -> DeviceArray:
    """An array in the same memory."""
    return cast(Any, wp).array(values, dtype=wp.float32, device="cpu", copy=False)


def _numpy(array: DeviceArray) -> npt.NDArray[Any]:
    """A copy of an array, in ordinary memory."""
    values: npt.NDArray[Any] = array.numpy()
    return values.copy() if array.device.is_cpu else values


def _empty(size: int, **options: Any) -> DeviceArray:
    return cast(Any, wp).empty(size, dtype=wp.float32, **options)


def _words_of(array: DeviceArray) -> DeviceArray:
    """The 32-bit words of an array, in the same memory."""
    words = array.size * wp.types.type_size_in_bytes(array.dtype) // 4
    return cast(Any, wp).array(ptr=array.ptr, dtype=wp.float32, shape=words, device=array.device, copy=False)
