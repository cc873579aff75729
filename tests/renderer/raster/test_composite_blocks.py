"""Thread blocks that share a tile's splats give the bits of one item per pixel."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import TILE_PX
from lumisplat.device.structs.raster import SplatEllipsoid
from lumisplat.renderer.raster import splat_kernels
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from support.kernels import compile_for_cuda
from support.scenes.raster_scenes import front_camera, quad, random_gaussians

LAYERS = ("color", "alpha", "normal", "depth", "gaussian_index", "instance_index")


class ByPixels(Launcher):
    """A launcher that composites each pixel separately."""

    def run_blocks(self, kernel: Any, blocks: int, *inputs: object) -> None:
        """Runs one thread for each pixel instead of thread blocks."""
        assert kernel is splat_kernels.composite_blocks
        no_ellipsoids = Buffers("cpu").get("none", SplatEllipsoid, 0)
        self.run_banded(splat_kernels.composite_pixels, blocks * TILE_PX * TILE_PX, *inputs, no_ellipsoids)


@pytest.mark.parametrize("opacity", [0.02, 0.3, 0.95])
@pytest.mark.parametrize("with_mesh", [False, True])
def test_compositing_by_blocks_that_share_splats_equals_compositing_pixel_by_pixel(
    opacity: float, with_mesh: bool
) -> None:
    """Tiles have more splats than a block has threads; pixels end by opacity, at a mesh, or at the end of the list."""
    gaussians = random_gaussians(
        8, 2200, extent=(1.0, 0.6, 1.5), scale_range=(0.1, 0.5), opacities=np.full(2200, opacity)
    )
    scene = ls.Scene([gaussians], [quad(4.0, half=0.5)] if with_mesh else [])
    camera = front_camera(40, 24)
    frames = [
        ls.Renderer(ls.RenderConfig(), launcher).render(scene, camera)
        for launcher in (ByPixels("cpu", parallel=True), Launcher("cpu", parallel=True))
    ]
    assert frames[0].stats is not None
    assert frames[0].stats.pair_count > 3 * TILE_PX * TILE_PX * 6, "the lists are short"
    for name in LAYERS:
        np.testing.assert_array_equal(getattr(frames[0], name), getattr(frames[1], name), name)


def test_cuda_compositing_kernel_reads_splats_from_shared_memory() -> None:
    """Splats are read by 16-byte loads, and launch bounds allow four blocks per multiprocessor."""
    code = compile_for_cuda(splat_kernels.BLOCKS).read_text()
    assert re.search(r"\.maxntid 256", code) and re.search(r"\.minnctapersm 4", code)
    assert len(re.findall(r"ld\.shared\.v4", code)) >= 3
