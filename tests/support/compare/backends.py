"""Backends of the renderer, which must all compute equal frames."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.runtime.launcher import Launcher
from support.compare.graph_launcher import GraphLauncher

BACKENDS = ["cpu", "cpu as cuda", "cpu as graph", *(device.alias for device in wp.get_cuda_devices())]
"""The CPU with CPU kernels, the CPU with CUDA's kernels, the CPU with CUDA's kernels replayed as a graph, and every
GPU."""


class ReplayingRenderer(ls.Renderer):
    """Renders each frame four times: directly twice, while capturing a graph, and from the graph."""

    def render(self, scene: ls.Scene, camera: ls.Camera, **options: Any) -> ls.Frame:
        """Returns the frame replayed from the graph, and asserts that the three frames rendered before are equal."""
        frames = [super(ReplayingRenderer, self).render(scene, camera, **options) for _ in range(4)]
        for frame in frames[:-1]:
            np.testing.assert_array_equal(frame.color, frames[-1].color, "the graph's frame is not the direct one")
        return frames[-1]


def renderer_of(backend: str, config: ls.RenderConfig | None = None, *, lists: bool = True) -> ls.Renderer:
    """Returns a renderer with one of ``BACKENDS``, whose camera rays use lists by tiles where they can, or BVHs."""
    if not lists:
        return without_lists(renderer_of(backend, config))
    renderer = ls.create_renderer(config, backend.partition(" as ")[0])
    if backend == "cpu":
        return renderer
    if backend == "cpu as cuda":
        return ls.Renderer(renderer.config, Launcher("cpu", parallel=True))
    return ReplayingRenderer(renderer.config, GraphLauncher() if backend == "cpu as graph" else Launcher(backend))


def without_lists(renderer: ls.Renderer) -> ls.Renderer:
    """Returns the renderer, whose camera rays then traverse BVHs instead of lists of Gaussians by tiles."""

    def plan_of(scene: ls.Scene, camera: ls.Camera | None = None) -> FramePlan:
        return FramePlan.of(renderer.config, scene)

    renderer._plan_of = plan_of
    return renderer


LISTS_AND_BVHS = pytest.mark.parametrize("lists", [True, False], ids=["lists", "BVHs"])
"""Runs a test twice: camera rays find Gaussians in lists by tiles, or in BVHs."""
