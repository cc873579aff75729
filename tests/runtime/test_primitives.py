"""Sums and sorts of Warp's library, and their failures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from lumisplat.errors import DeviceError
from lumisplat.runtime.buffers import DeviceArray
from lumisplat.runtime.primitives import error_message, prefix_sum, sort_pairs


def ints(values: list[int]) -> DeviceArray:
    """Makes a CPU array of integers."""
    return DeviceArray(np.array(values, np.int32), dtype=wp.int32, device="cpu")


def test_device_sort_is_stable_and_compares_only_the_given_number_of_low_key_bits() -> None:
    """Only the low bits of keys are compared; values of equal keys keep their order."""
    keys, values = ints([7, 1, 6, 2, 0, 0, 0, 0]), ints([0, 1, 2, 3, 9, 9, 9, 9])
    sort_pairs(keys, values, 4, bits=1)
    assert keys.numpy()[:4].tolist() == [6, 2, 7, 1]
    assert values.numpy()[:4].tolist() == [2, 3, 0, 1]


def test_device_sort_that_fails_silently_raises_a_device_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without scratch memory, the library returns normally and leaves a message, which is raised once per failure."""
    message = b"Warp sort error: Failed to acquire radix sort buffer"
    sort = wp.utils.radix_sort_pairs

    def fail(*_: Any, **__: Any) -> None:
        error_message().value = message

    for _ in range(2):  # the same message twice is two failures
        monkeypatch.setattr(wp.utils, "radix_sort_pairs", fail)
        with pytest.raises(DeviceError, match=r"cpu cannot sort 4 elements: .*Failed to acquire"):
            sort_pairs(ints([2, 1, 0, 0]), ints([0, 1, 0, 0]), 2)
        monkeypatch.setattr(wp.utils, "radix_sort_pairs", sort)
        keys = ints([2, 1, 0, 0])
        sort_pairs(keys, ints([0, 1, 0, 0]), 2)
        assert keys.numpy()[:2].tolist() == [1, 2]


def test_device_sort_is_retried_once_after_a_failed_allocation(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a failed allocation on a GPU, CUB's next sort reports the old failure without sorting."""
    sort, tries = wp.utils.radix_sort_pairs, []

    def fail_once(*given: Any, **options: Any) -> None:
        tries.append(1)
        if len(tries) == 1:
            error_message().value = b"Warp CUDA error 101: invalid device ordinal"
        else:
            sort(*given, **options)

    monkeypatch.setattr(wp.utils, "radix_sort_pairs", fail_once)
    keys = ints([2, 1, 0, 0])
    sort_pairs(keys, ints([0, 1, 0, 0]), 2)
    assert keys.numpy()[:2].tolist() == [1, 2] and len(tries) == 2


def test_device_sum_that_fails_raises_a_device_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error of the library becomes one line, like that of any other allocation."""

    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("Warp CUDA error 2: out of memory\n(in function wp_alloc_device)")

    monkeypatch.setattr(wp.utils, "array_scan", fail)
    with pytest.raises(DeviceError, match=r"^cpu cannot sum 3 elements: Warp CUDA error 2: out of memory \(in"):
        prefix_sum(ints([1, 2, 3]), ints([0, 0, 0]), inclusive=True)


@pytest.mark.parametrize("name", ["array_scan", "radix_sort_pairs"])
def test_device_sums_and_sorts_run_on_the_device_of_their_arrays(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The library uses the current CUDA context of the thread, which may belong to another GPU."""
    entered: list[str] = []
    scoped = wp.ScopedDevice

    class Scoped(scoped):
        def __enter__(self) -> Any:
            entered.append(f"enter {self.device}")
            return super().__enter__()

        def __exit__(self, *error: Any) -> None:
            entered.append("exit")
            super().__exit__(*error)

    monkeypatch.setattr(wp, "ScopedDevice", Scoped)
    monkeypatch.setattr(wp.utils, name, lambda *_, **__: entered.append("work"))
    if name == "array_scan":
        prefix_sum(ints([1]), ints([0]), inclusive=True)
    else:
        sort_pairs(ints([1, 0]), ints([0, 0]), 1)
    assert entered == ["enter cpu", "work", "exit"]
