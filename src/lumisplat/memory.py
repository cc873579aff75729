"""How much memory there is."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

_OF_CONTAINER = Path("/sys/fs/cgroup/memory.max")
"""What a container may use, a number of bytes or ``max``."""


def usable_memory() -> int | None:
    """What this process may use, bytes: the machine's, or its container's if that is less; None: nothing tells."""
    limits: list[int] = []
    with contextlib.suppress(AttributeError, ValueError, OSError):  # no sysconf on Windows
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    with contextlib.suppress(ValueError, OSError):
        limits.append(int(_OF_CONTAINER.read_text()))
    return min(limits, default=None)
