"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import hypothesis
import pytest

# The same examples everywhere in CI, new ones on a developer's machine; nothing is timed.
hypothesis.settings.register_profile("ci", derandomize=True, deadline=None)
hypothesis.settings.register_profile("local", deadline=None)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "local")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Real captures and meshes, where the machine has them."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("LUMISPLAT_DATA", default))
    if not path.is_dir():
        pytest.skip(f"no test data at {path} (set LUMISPLAT_DATA)")
    return path
