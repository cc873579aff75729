"""How much memory there is: the machine's, or less where a container has less."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lumisplat import memory

MACHINE = 1000 * 4096
"""Of the machine of these tests, bytes."""


@pytest.mark.parametrize(("written", "expected"), [("max\n", MACHINE), ("12345\n", 12345), (f"{2**60}\n", MACHINE)])
def test_the_less_of_machine_and_container(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, written: str, expected: int
) -> None:
    """A container without a limit says ``max``, and one may be allowed more than there is."""
    monkeypatch.setattr(os, "sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 1000}.__getitem__)
    limit = tmp_path / "memory.max"
    limit.write_text(written)
    monkeypatch.setattr(memory, "_OF_CONTAINER", limit)
    assert memory.usable_memory() == expected


def test_a_system_that_tells_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As Windows: there is no ``sysconf``, and no file of a container."""
    monkeypatch.delattr(os, "sysconf")
    monkeypatch.setattr(memory, "_OF_CONTAINER", tmp_path / "none")
    assert memory.usable_memory() is None
