"""What the tests of the renderer share: the devices, and drawing on them."""

from __future__ import annotations

import pytest
import warp as wp

import lumisplat as ls


@pytest.fixture(params=["cpu", *(device.alias for device in wp.get_cuda_devices())])
def device(request: pytest.FixtureRequest) -> str:
    """The CPU always, and every GPU there is."""
    return request.param


@pytest.fixture
def renderer(device: str) -> ls.Renderer:
    """A renderer with the default settings."""
    return ls.create_renderer(device=device)
