"""Steps for the tests of `bench.gpu`, one for each way in which a step can end."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

from bench.gpu.worker import Finding, Setting


def passes(setting: Setting) -> Iterator[Finding]:
    """Yields a correct finding."""
    yield Finding("device", setting.device)


def finds(_: Setting) -> Iterator[Finding]:
    """Yields a wrong finding and a correct one, and ends."""
    yield Finding("a pixel", [1.0, 2.0], is_wrong=True)
    yield Finding("another", 3)


def raises(_: Setting) -> Iterator[Finding]:
    """Yields a finding, then raises an exception."""
    yield Finding("before", 1)
    raise RuntimeError("the context is poisoned")


def dies(_: Setting) -> Iterator[Finding]:
    """Yields a finding, then aborts its process."""
    yield Finding("before", 2)
    os.abort()


def hangs(_: Setting) -> Iterator[Finding]:
    """Yields a finding, then never ends."""
    yield Finding("before", 3)
    time.sleep(600.0)


def skips(_: Setting) -> Iterator[Finding]:
    """Reports that the step cannot run on this machine."""
    yield Finding("skipped", "no such thing here")
