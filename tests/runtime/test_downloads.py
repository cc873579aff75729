"""Page-locked memory that frames are downloaded to: whose it is, and when it is used again."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from lumisplat.constants import HOST_BLOCKS_MAX
from lumisplat.runtime.buffers import DeviceArray
from lumisplat.runtime.downloads import Downloads


def array_of(values: list[float]) -> DeviceArray:
    """As on a device."""
    return DeviceArray(np.array(values, np.float32), dtype=wp.float32, device="cpu")


def test_lent_memory_stays_with_who_holds_it() -> None:
    """A view alone keeps the block; the next copy goes elsewhere."""
    lender, source = Downloads(), array_of([1.0, 2.0, 3.0, 4.0])
    first = lender.lend(source)
    part = first[1:3].reshape(2, 1)
    del first
    source.fill_(7.0)
    second = lender.lend(source)
    assert lender.lent == 2
    assert part.ravel().tolist() == [2.0, 3.0]
    assert second.tolist() == [7.0] * 4


def test_memory_is_lent_again() -> None:
    """Once nobody holds a frame, the next one of its size is written there; another size gets new memory."""
    lender, source = Downloads(), array_of([1.0, 2.0])
    first = lender.lend(source)
    address = first.ctypes.data
    del first
    assert lender.lent == 0
    second = lender.lend(source)
    assert second.ctypes.data == address
    del second
    other = lender.lend(array_of([5.0, 6.0, 7.0]))
    assert other.tolist() == [5.0, 6.0, 7.0]


def test_copies_on_the_cpu_are_their_own() -> None:
    """However many frames are kept: what is written later does not reach them."""
    lender, source = Downloads(), array_of([0.0])
    kept = []
    for number in range(5):
        source.fill_(float(number))
        kept.append(lender.numpy(source))
    assert [float(copy[0]) for copy in kept] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert lender.lent == 0


def test_many_frames_do_not_lock_all_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of frames that a program keeps, the first few hold page-locked memory, the others ordinary one."""
    lender = Downloads()
    on_gpu: Any = SimpleNamespace(device=SimpleNamespace(is_cpu=False), numpy=lambda: np.zeros(1))
    source = array_of([1.0])
    lend = lender.lend
    monkeypatch.setattr(lender, "lend", lambda _: lend(source))
    kept = [lender.numpy(on_gpu) for _ in range(HOST_BLOCKS_MAX + 2)]
    assert lender.lent == HOST_BLOCKS_MAX
    assert [float(copy[0]) for copy in kept] == [1.0] * HOST_BLOCKS_MAX + [0.0, 0.0]
    kept.clear()
    assert lender.lent == 0
