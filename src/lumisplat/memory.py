"""Memory limit of this process: the machine's memory, or less where a container or a job scheduler sets a limit.

Linux kills a process that exceeds the limit of its control group (cgroup); reading the limits first turns that into an
error with a message. See the kernel's documentation of cgroup v1 (``memory.limit_in_bytes``), of v2 (``memory.max``),
and ``proc(5)`` for ``/proc/self/cgroup`` and ``/proc/self/mountinfo``.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

_PROCESS = Path("/proc/self")
"""Folder with this process's ``cgroup`` and ``mountinfo`` files."""

_LIMIT = {"cgroup2": "memory.max", "cgroup": "memory.limit_in_bytes"}
"""File that holds a control group's limit (bytes or ``max``), by type of file system."""


def usable_memory() -> int | None:
    """Returns the memory that this process may use, in bytes; None where the system does not report it.

    It is the smallest of the machine's memory and the limits of the process's control group and of all its parents.
    """
    limits: list[int] = []
    with contextlib.suppress(AttributeError, ValueError, OSError):  # no sysconf on Windows
        limits.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for group in _control_groups():
        for name in _LIMIT.values():
            with contextlib.suppress(ValueError, OSError):  # "max", or no limit in this group
                limits.append(int((group / name).read_text()))
    return min(limits, default=None)


def _control_groups() -> Iterator[Path]:
    """Yields the folders of the memory control groups that hold this process, the innermost first."""
    try:
        memberships = [line.split(":", 2) for line in (_PROCESS / "cgroup").read_text().splitlines()]
        mounts = [line.split(" ") for line in (_PROCESS / "mountinfo").read_text().splitlines()]
    except OSError:
        return
    groups = {
        "cgroup2" if not controllers else "cgroup": PurePosixPath(path)
        for _, controllers, path in memberships
        if not controllers or "memory" in controllers.split(",")
    }
    for fields in mounts:
        kind, options = fields[fields.index("-") + 1], fields[-1].split(",")
        if kind not in groups or (kind == "cgroup" and "memory" not in options):
            continue
        root, mount = PurePosixPath(fields[3]), Path(fields[4])
        group = groups[kind]
        # A container sees its own group as the root of the mount, and may see a path from outside of it.
        inner = group.relative_to(root) if group.is_relative_to(root) else PurePosixPath()
        yield from (mount / folder for folder in (inner, *inner.parents))
