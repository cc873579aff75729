"""The ways a frame can be computed: all must show the same."""

from __future__ import annotations

import warp as wp

import lumisplat as ls
from lumisplat.launcher import Launcher

WAYS = ["cpu", "cpu as cuda", *(device.alias for device in wp.get_cuda_devices())]
"""The CPU with its own kernels and with those of CUDA, and every GPU there is."""


def renderer_of(way: str, config: ls.RenderConfig | None = None) -> ls.Renderer:
    """A renderer that works in one of ``WAYS``."""
    renderer = ls.create_renderer(config, way.removesuffix(" as cuda"))
    if way.endswith("as cuda"):
        return ls.Renderer(renderer.config, Launcher("cpu", parallel=True))
    return renderer
