"""Counts what a renderer asks of a GPU's driver: each graph, kernel, copy and read-back that the host issues."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

import pytest
import warp as wp

from lumisplat.runtime.buffers import Buffers

GRAPH, LAUNCH, UPLOAD, COPY, READ, ALLOCATION = "graph", "launch", "upload", "copy", "read", "allocation"
"""Kinds of calls: a replayed graph; a kernel, sum or sort; a copy from host memory; a fill or a copy on the device; a
read-back, for which the host waits; and an array of `Buffers`."""

_CALLS = {
    GRAPH: [(wp, "capture_launch")],
    LAUNCH: [(wp, "launch"), (wp.utils, "array_scan"), (wp.utils, "radix_sort_pairs")],
    UPLOAD: [(wp.array, "assign")],
    COPY: [(wp, "copy"), (wp.array, "zero_"), (wp.array, "fill_")],
    READ: [(wp.array, "numpy")],
    ALLOCATION: [(Buffers, "_allocate")],
}


@contextmanager
def driver_calls() -> Generator[Counter[str]]:
    """Counts the calls within the ``with`` block, by kind; a call that another one makes does not count."""
    counts: Counter[str] = Counter()
    is_within = False

    def counted(kind: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def call(*inputs: Any, **options: Any) -> Any:
            nonlocal is_within
            if is_within:
                return work(*inputs, **options)
            counts[kind] += 1
            is_within = True
            try:
                return work(*inputs, **options)
            finally:
                is_within = False

        return call

    with pytest.MonkeyPatch.context() as patched:
        for kind, functions in _CALLS.items():
            for where, name in functions:
                patched.setattr(where, name, counted(kind, getattr(where, name)))
        yield counts
