"""Fixtures that the renderer's tests share."""

from __future__ import annotations

import pytest

import lumisplat as ls
from support.compare.backends import BACKENDS, renderer_of


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    """Yields each backend in turn: the device, launch schedule and graph capture with which a frame is computed."""
    return request.param


@pytest.fixture
def renderer(backend: str) -> ls.Renderer:
    """Returns a renderer with default settings on one backend."""
    return renderer_of(backend)
