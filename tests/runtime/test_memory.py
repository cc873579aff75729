"""Usable memory: the smallest of the machine's memory and the limits of all control groups of the process."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lumisplat import memory

MACHINE = 1000 * 4096
"""Memory of the simulated machine in bytes."""

UNLIMITED = 9223372036854771712
"""Value that means "no limit" in cgroup v1."""


@pytest.fixture
def system(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Returns a function that writes the control groups of a process, its mounts and their limits."""
    monkeypatch.setattr(os, "sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 1000}.__getitem__)
    monkeypatch.setattr(memory, "_PROCESS", tmp_path)

    def write(cgroup: str, mounts: list[tuple[str, str, str, str]], limits: dict[str, object]) -> None:
        (tmp_path / "cgroup").write_text(cgroup)
        lines = [
            f"30 23 0:27 {root} {tmp_path / mount} rw,nosuid shared:4 - {kind} {kind} {options}\n"
            for root, mount, kind, options in mounts
        ]
        (tmp_path / "mountinfo").write_text("22 1 8:1 / / rw - ext4 /dev/vda rw\n" + "".join(lines))
        for name, value in limits.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(f"{value}\n")

    return write


V2 = [("/", "fs", "cgroup2", "rw")]
V1 = [("/", "cpu", "cgroup", "rw,cpu"), ("/", "fs", "cgroup", "rw,memory"), ("/", "unified", "cgroup2", "rw")]


@pytest.mark.parametrize(
    ("cgroup", "mounts", "limits", "expected"),
    [
        ("0::/\n", V2, {"fs/memory.max": "max"}, MACHINE),
        ("0::/\n", V2, {"fs/memory.max": 12345}, 12345),
        ("0::/\n", V2, {"fs/memory.max": 2**60}, MACHINE),
        ("0::/user/job\n", V2, {"fs/user/job/memory.max": 777, "fs/user/memory.max": "max"}, 777),
        ("0::/user/job/step\n", V2, {"fs/user/job/step/memory.max": "max", "fs/user/memory.max": 555}, 555),
        ("0::/user/job\n", V2, {"fs/other/memory.max": 5}, MACHINE),
        ("3:cpu,memory:/slurm/job_1\n0::/\n", V1, {"fs/slurm/job_1/memory.limit_in_bytes": 888}, 888),
        ("4:memory:/slurm/job_1\n", V1, {"fs/slurm/memory.limit_in_bytes": 999}, 999),
        ("4:memory:/a\n", V1, {"fs/a/memory.limit_in_bytes": UNLIMITED, "cpu/a/memory.limit_in_bytes": 1}, MACHINE),
        ("4:memory:/docker/1\n", [("/docker/1", "fs", "cgroup", "rw,memory")], {"fs/memory.limit_in_bytes": 66}, 66),
        ("0::/docker/1\n", [("/../..", "fs", "cgroup2", "rw")], {"fs/memory.max": 44}, 44),
    ],
    ids=[
        "v2 without a limit", "v2 root", "v2 above the machine", "v2 systemd", "v2 nested", "v2 another group",
        "v1 Slurm", "v1 parent", "v1 without a limit", "v1 in a container", "v2 seen from outside",
    ],
)  # fmt: skip
def test_usable_memory_is_the_smaller_of_machine_memory_and_control_group_limits(
    system, cgroup, mounts, limits, expected
) -> None:
    """Limits of parent groups count; limits of other groups and of other controllers do not."""
    system(cgroup, mounts, limits)
    assert memory.usable_memory() == expected


def test_system_without_sysconf_and_control_groups_reports_no_memory_limit(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Windows has neither ``sysconf`` nor ``/proc``."""
    monkeypatch.delattr(os, "sysconf")
    monkeypatch.setattr(memory, "_PROCESS", tmp_path)
    assert memory.usable_memory() is None
