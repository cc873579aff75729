"""Fixtures shared by all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Real captures and meshes, where the machine has them."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("LUMISPLAT_DATA", default))
    if not path.is_dir():
        pytest.skip(f"no test data at {path} (set LUMISPLAT_DATA)")
    return path
