"""The ways a frame can be computed: all must show the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

import lumisplat as ls
from lumisplat.runtime.launcher import Launcher
from support.compare.graph_launcher import GraphLauncher

WAYS = ["cpu", "cpu as cuda", "cpu as graph", *(device.alias for device in wp.get_cuda_devices())]
"""The CPU with its own kernels, with those of CUDA, and with those replayed as a graph; and every GPU there is."""


class ReplayingRenderer(ls.Renderer):
    """Draws a frame until it comes from a graph: direct with new buffers, direct, captured, replayed."""

    def render(self, scene: ls.Scene, camera: ls.Camera, **options: Any) -> ls.Frame:
        """The replayed frame; the others must be equal to it."""
        frames = [super(ReplayingRenderer, self).render(scene, camera, **options) for _ in range(4)]
        for frame in frames[:-1]:
            np.testing.assert_array_equal(frame.color, frames[-1].color, "the graph's frame is not the direct one")
        return frames[-1]


def renderer_of(way: str, config: ls.RenderConfig | None = None) -> ls.Renderer:
    """A renderer that works in one of ``WAYS``."""
    renderer = ls.create_renderer(config, way.partition(" as ")[0])
    if way == "cpu":
        return renderer
    if way == "cpu as cuda":
        return ls.Renderer(renderer.config, Launcher("cpu", parallel=True))
    return ReplayingRenderer(renderer.config, GraphLauncher() if way == "cpu as graph" else Launcher(way))
