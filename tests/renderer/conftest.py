"""Fixtures that the renderer's tests share."""

from __future__ import annotations

import pytest

import lumisplat as ls
from support.compare.ways import WAYS, renderer_of


@pytest.fixture(params=WAYS)
def way(request: pytest.FixtureRequest) -> str:
    """One backend: device, schedule and graph capture with which a frame is computed."""
    return request.param


@pytest.fixture
def renderer(way: str) -> ls.Renderer:
    """A renderer with default settings on one backend."""
    return renderer_of(way)
