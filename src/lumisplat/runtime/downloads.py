"""Copies of device arrays on the host.

A GPU writes to page-locked memory directly, and to other memory through small pieces that the processor copies. Such
memory is slow to get and taken from all programs, so that a few blocks are lent in turns: who holds a frame holds its
block, and a program that keeps many frames gets the others in ordinary memory.
"""

from __future__ import annotations

import weakref
from typing import Any, cast

import numpy.typing as npt
import warp as wp

from lumisplat.constants import HOST_BLOCKS_MAX

DeviceArray = Any
"""A Warp array; its type for host code is declared where buffers are, which hold this."""


class Downloads:
    """Lends page-locked memory to what is copied to the host."""

    def __init__(self) -> None:
        self._free: list[DeviceArray] = []
        self.lent = 0
        """Blocks whose arrays somebody still holds."""

    def numpy(self, array: DeviceArray) -> npt.NDArray[Any]:
        """A copy of an array of numbers, which nothing else writes to; waits for the device."""
        if array.device.is_cpu:
            return array.numpy().copy()  # the array itself is written again by the next frame
        return self.lend(array) if self.lent < HOST_BLOCKS_MAX else array.numpy()

    def lend(self, array: DeviceArray) -> npt.NDArray[Any]:
        """A copy in a block that is lent until the copy and all views of it are gone."""
        block = self._block(array)
        wp.copy(block, array)  # pyright: ignore[reportUnknownMemberType]
        wp.synchronize_device(array.device)
        copy = block.numpy()
        self.lent += 1
        weakref.finalize(copy, self._give_back, block).atexit = False
        return copy

    def _block(self, array: DeviceArray) -> DeviceArray:
        """A free block of this size; those of other sizes are given up, as images of one size follow each other."""
        self._free = [block for block in self._free if block.size == array.size and block.dtype == array.dtype]
        if self._free:
            return self._free.pop()
        pinned = not array.device.is_cpu  # a machine without a GPU has no page-locked memory to lend
        return cast(Any, wp).empty(array.size, dtype=array.dtype, device="cpu", pinned=pinned)

    def _give_back(self, block: DeviceArray) -> None:
        self.lent -= 1
        self._free.append(block)
