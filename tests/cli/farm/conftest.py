"""Provides a Ray cluster to the tests of farms."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from lumisplat.cli.farm.cluster import connected


@pytest.fixture(scope="session")
def ray() -> Iterator[Any]:
    """Yields a cluster on this machine for all tests of a process, as starting one takes seconds."""
    if importlib.util.find_spec("ray") is None:  # not imported, as Ray reads its settings when imported
        pytest.skip("Ray is not installed: pip install 'lumisplat[farm]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))  # workers import tests' helpers
        with connected("local", 4) as found:
            yield found
