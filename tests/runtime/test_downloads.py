"""Downloads: which memory holds copies of frames, and when it is reused."""

from __future__ import annotations

from threading import Thread
from typing import Any

import numpy as np
import pytest
import warp as wp

from lumisplat.runtime import downloads
from lumisplat.runtime.buffers import DeviceArray
from lumisplat.runtime.downloads import FRAME_BLOCKS_MAX, DeviceCopies, Downloads, HostCopies


def array_of(*values: float) -> DeviceArray:
    """Makes a Warp array of floats."""
    return DeviceArray(np.array(values, np.float32), dtype=wp.float32, device="cpu")


def vectors_of(*rows: tuple[float, float, float]) -> DeviceArray:
    """Makes a Warp array of vectors."""
    return DeviceArray(np.array(rows, np.float32), dtype=wp.vec3, device="cpu")


@pytest.mark.parametrize("is_lazy", [False, True])
def test_device_copy_of_an_array_keeps_its_values_when_the_array_is_overwritten(is_lazy: bool) -> None:
    """The copy has the values at the time of copying, whenever and however it is read."""
    lender, color, alpha = Downloads(is_lazy=is_lazy), vectors_of((1, 2, 3), (4, 5, 6)), array_of(0.5, 0.25)
    copies = lender.copies({"color": color, "alpha": alpha})
    color.fill_(7.0)
    alpha.fill_(7.0)
    assert isinstance(copies, DeviceCopies if is_lazy else HostCopies)
    assert copies.words("alpha").tolist() == [0.5, 0.25]
    assert copies.words("color", 3).tolist() == [4.0, 5.0, 6.0]
    assert copies.words("color", 1, 2).tolist() == [2.0, 3.0]
    given = copies.lazy(lambda: 5)
    assert (given() if callable(given) else given) == 5
    assert callable(given) == is_lazy


def test_reading_part_of_a_device_copy_downloads_only_that_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each read downloads only the 32-bit words that it asks for."""
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


def test_host_memory_of_a_download_is_not_reused_while_a_view_of_it_exists() -> None:
    """A single NumPy view keeps the host block in use; the next copies use other memory."""
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


def test_host_memory_of_a_dropped_frame_is_reused_by_the_next_frame() -> None:
    """A frame of another size gets a new block."""
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


def test_further_frames_are_downloaded_at_once_if_many_wait_on_the_device() -> None:
    """If a program keeps many frames, the first few stay on the device, and the others are downloaded at once."""
    lender = Downloads(is_lazy=True)
    held = [lender.copies({"a": array_of(float(number))}) for number in range(FRAME_BLOCKS_MAX + 2)]
    lazy = [isinstance(copies, DeviceCopies) for copies in held]
    assert lazy == [True] * FRAME_BLOCKS_MAX + [False, False]
    assert [float(copies.words("a")[0]) for copies in held] == list(range(FRAME_BLOCKS_MAX + 2))
    held.clear()
    assert lender.lent == {"host": 0, "device": 0}


def test_number_of_frames_in_page_locked_memory_is_limited() -> None:
    """If a program keeps many images, a few use page-locked memory, and the others ordinary memory."""
    lender = Downloads(is_lazy=True)
    held = [lender.copies({"a": array_of(number, 9.0)}).words("a", 0, 1) for number in range(FRAME_BLOCKS_MAX + 2)]
    assert lender.lent == {"host": FRAME_BLOCKS_MAX, "device": 0}
    assert [float(image[0]) for image in held] == list(range(FRAME_BLOCKS_MAX + 2))


def test_frame_is_downloaded_at_once_if_device_memory_has_no_room_for_its_copy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without device memory for a second copy, the frame is downloaded at once."""

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(downloads, "_empty", refuse)
    lender = Downloads(is_lazy=True)
    copies = lender.copies({"a": array_of(3.0)})
    assert isinstance(copies, HostCopies)
    assert copies.words("a").tolist() == [3.0]
    assert lender.lent == {"host": 0, "device": 0}


def test_garbage_collection_while_a_memory_block_is_taken_may_return_another_block(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A garbage collection on the same thread may return a block while one is taken, without deadlock or loss."""
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
    assert lender.device_bytes == 16  # includes returned blocks, until a frame of another size


def test_threads_that_take_memory_blocks_at_once_do_not_exceed_their_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two threads compete for the last block while the first thread is still allocating; only one gets the block."""
    lender = Downloads(is_lazy=True)
    held = [lender.copies({"a": array_of(1.0)}) for _ in range(FRAME_BLOCKS_MAX - 1)]
    make = downloads._empty  # pyright: ignore[reportPrivateUsage]
    other = Thread(target=lambda: held.append(lender.copies({"a": array_of(2.0)})))

    def interrupted(*args: Any, **options: Any) -> Any:
        if other.ident is None:
            other.start()
            other.join(0.2)  # the lock makes this thread wait; without a lock it would finish
        return make(*args, **options)

    monkeypatch.setattr(downloads, "_empty", interrupted)
    held.append(lender.copies({"a": array_of(3.0)}))
    other.join()
    assert lender.lent == {"host": 0, "device": FRAME_BLOCKS_MAX}
    assert sum(isinstance(copies, DeviceCopies) for copies in held) == FRAME_BLOCKS_MAX


def test_awaited_number_is_waited_for_once_and_then_kept() -> None:
    """A frame keeps its count although the next frame writes the count's copy again."""
    values, waits = [3], list[int]()
    awaited = downloads.Awaited(lambda: waits.append(1), lambda: values[0])
    assert not waits
    assert awaited() == 3
    values[0] = 4
    assert awaited() == 3
    assert waits == [1]
