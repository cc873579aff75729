"""Steps for the tests of `bench.first_light`: what can become of one."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

from bench.first_light.worker import Finding, Setting


def passes(setting: Setting) -> Iterator[Finding]:
    """Finds nothing wrong."""
    yield Finding("device", setting.device)


def finds(_: Setting) -> Iterator[Finding]:
    """Finds something wrong, and ends."""
    yield Finding("a pixel", [1.0, 2.0], is_wrong=True)
    yield Finding("another", 3)


def raises(_: Setting) -> Iterator[Finding]:
    """Finds something, then fails."""
    yield Finding("before", 1)
    raise RuntimeError("the context is poisoned")


def dies(_: Setting) -> Iterator[Finding]:
    """Takes its process along."""
    yield Finding("before", 2)
    os.abort()


def hangs(_: Setting) -> Iterator[Finding]:
    """Does not end."""
    yield Finding("before", 3)
    time.sleep(600.0)


def skips(_: Setting) -> Iterator[Finding]:
    """Cannot run here."""
    yield Finding("skipped", "no such thing here")
