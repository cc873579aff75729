"""Copies that frames download from: whose memory they are in, and when it is used again."""

from __future__ import annotations

from threading import Thread
from typing import Any

import numpy as np
import pytest
import warp as wp

from lumisplat.runtime import downloads
from lumisplat.runtime.buffers import DeviceArray
from lumisplat.runtime.downloads import FRAME_BLOCKS_MAX, CopiesLater, CopiesNow, Downloads


def array_of(*values: float) -> DeviceArray:
    """As on a device."""
    return DeviceArray(np.array(values, np.float32), dtype=wp.float32, device="cpu")


def vectors_of(*rows: tuple[float, float, float]) -> DeviceArray:
    """An array of vectors."""
    return DeviceArray(np.array(rows, np.float32), dtype=wp.vec3, device="cpu")


@pytest.mark.parametrize("is_lazy", [False, True])
def test_copies_are_of_the_moment(is_lazy: bool) -> None:
    """What is written later does not reach them, whenever they are read, and whatever part of them."""
    lender, color, alpha = Downloads(is_lazy=is_lazy), vectors_of((1, 2, 3), (4, 5, 6)), array_of(0.5, 0.25)
    copies = lender.copies({"color": color, "alpha": alpha})
    color.fill_(7.0)
    alpha.fill_(7.0)
    assert isinstance(copies, CopiesLater if is_lazy else CopiesNow)
    assert copies.words("alpha").tolist() == [0.5, 0.25]
    assert copies.words("color", 3).tolist() == [4.0, 5.0, 6.0]
    assert copies.words("color", 1, 2).tolist() == [2.0, 3.0]
    given = copies.give(lambda: 5)
    assert (given() if callable(given) else given) == 5
    assert callable(given) == is_lazy


def test_only_what_is_read_is_copied_to_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    """Word by word."""
    lender = Downloads(is_lazy=True)
    copies = lender.copies({"color": vectors_of((1, 2, 3), (4, 5, 6)), "alpha": array_of(0.5, 0.25)})
    copied: list[int] = []
    copy = wp.copy

    def counting(target: Any, source: Any, first: int, source_first: int, count: int, **options: Any) -> None:
        copied.append(count)
        copy(target, source, first, source_first, count, **options)

    monkeypatch.setattr(wp, "copy", counting)
    assert lender.lent == {"host": 0, "device": 1}
    copies.words("alpha")
    assert copied == [2]
    assert lender.lent == {"host": 1, "device": 1}


def test_lent_memory_stays_with_who_holds_it() -> None:
    """A view alone keeps the block on the host; the next copies go elsewhere."""
    lender, source = Downloads(is_lazy=True), array_of(1.0, 2.0, 3.0, 4.0)
    part = lender.copies({"a": source}).words("a", 1, 2).reshape(2, 1)
    assert lender.lent == {"host": 1, "device": 0}
    source.fill_(7.0)
    second = lender.copies({"a": source}).words("a")
    assert lender.lent == {"host": 2, "device": 0}
    assert part.ravel().tolist() == [2.0, 3.0]
    assert second.tolist() == [7.0] * 4
    del part, second
    assert lender.lent == {"host": 0, "device": 0}


def test_memory_is_lent_again() -> None:
    """Once nobody holds a frame, the next one of its size is written there; another size gets new memory."""
    lender, source = Downloads(is_lazy=True), array_of(1.0, 2.0)
    first = lender.copies({"a": source}).words("a")
    address = first.ctypes.data
    del first
    second = lender.copies({"a": source}).words("a")
    assert second.ctypes.data == address
    del second
    assert lender.device_bytes == 8
    other = lender.copies({"a": array_of(5.0, 6.0, 7.0)}).words("a")
    assert other.tolist() == [5.0, 6.0, 7.0]
    assert lender.device_bytes == 12


def test_many_frames_do_not_take_all_memory() -> None:
    """Of frames that a program keeps, the first few wait on the device, the others are downloaded at once."""
    lender = Downloads(is_lazy=True)
    kept = [lender.copies({"a": array_of(float(number))}) for number in range(FRAME_BLOCKS_MAX + 2)]
    lazy = [isinstance(copies, CopiesLater) for copies in kept]
    assert lazy == [True] * FRAME_BLOCKS_MAX + [False, False]
    assert [float(copies.words("a")[0]) for copies in kept] == list(range(FRAME_BLOCKS_MAX + 2))
    kept.clear()
    assert lender.lent == {"host": 0, "device": 0}


def test_many_images_do_not_lock_all_memory() -> None:
    """Images that a program keeps hold page-locked memory for a few frames, and ordinary one for the others."""
    lender = Downloads(is_lazy=True)
    kept = [lender.copies({"a": array_of(number, 9.0)}).words("a", 0, 1) for number in range(FRAME_BLOCKS_MAX + 2)]
    assert lender.lent == {"host": FRAME_BLOCKS_MAX, "device": 0}
    assert [float(image[0]) for image in kept] == list(range(FRAME_BLOCKS_MAX + 2))


def test_a_full_device_downloads_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is no room for a second copy of a frame, it is not needed either."""

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(downloads, "_empty", refuse)
    lender = Downloads(is_lazy=True)
    copies = lender.copies({"a": array_of(3.0)})
    assert isinstance(copies, CopiesNow)
    assert copies.words("a").tolist() == [3.0]
    assert lender.lent == {"host": 0, "device": 0}


def test_memory_may_come_back_while_more_is_lent(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when the garbage collector runs in the middle of it, on the same thread: nothing waits, nothing is lost."""
    lender = Downloads(is_lazy=True)
    held = [lender.copies({"a": array_of(1.0)})]
    make = downloads._empty  # pyright: ignore[reportPrivateUsage]

    def dropping(*args: Any, **options: Any) -> Any:
        held.clear()
        return make(*args, **options)

    monkeypatch.setattr(downloads, "_empty", dropping)
    kept = lender.copies({"a": array_of(2.0, 3.0)})
    assert lender.lent == {"host": 0, "device": 1}
    assert kept.words("a").tolist() == [2.0, 3.0]
    assert lender.device_bytes == 16  # of what came back, too, until the next frame of another size


def test_threads_that_lend_at_once_do_not_lend_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last block goes to one of two threads, although the second one asks while the first gets its memory."""
    lender = Downloads(is_lazy=True)
    held = [lender.copies({"a": array_of(1.0)}) for _ in range(FRAME_BLOCKS_MAX - 1)]
    make = downloads._empty  # pyright: ignore[reportPrivateUsage]
    other = Thread(target=lambda: held.append(lender.copies({"a": array_of(2.0)})))

    def interrupted(*args: Any, **options: Any) -> Any:
        if other.ident is None:
            other.start()
            other.join(0.2)  # it has to wait; without a lock, it is done by then
        return make(*args, **options)

    monkeypatch.setattr(downloads, "_empty", interrupted)
    held.append(lender.copies({"a": array_of(3.0)}))
    other.join()
    assert lender.lent == {"host": 0, "device": FRAME_BLOCKS_MAX}
    assert sum(isinstance(copies, CopiesLater) for copies in held) == FRAME_BLOCKS_MAX
