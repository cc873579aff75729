"""What the tests of the renderer share."""

from __future__ import annotations

import pytest

import lumisplat as ls
from support.compare.ways import WAYS, renderer_of


@pytest.fixture(params=WAYS)
def way(request: pytest.FixtureRequest) -> str:
    """One way to compute a frame."""
    return request.param


@pytest.fixture
def renderer(way: str) -> ls.Renderer:
    """A renderer with the default settings."""
    return renderer_of(way)
