"""Backward pass of the EWA rasteriser, from gradients at pixels to gradients of splats, Gaussians and camera pose."""

from __future__ import annotations

import math

from lumisplat.constants import POSE_CHUNK, TILE_BANDS_PER_THREAD
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient, PoseGradient, SplatGradient
from lumisplat.renderer.gradients import splat_backward_kernels as kernels
from lumisplat.renderer.gradients.arrays import gradient_of_asset
from lumisplat.renderer.raster.binning import pair_starts
from lumisplat.renderer.raster.unlit_raster import DrawnSplats
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher


class SplatBackward:
    """Computes gradients of splats from gradients at pixels, then gradients of Gaussians and of the camera pose.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    def modules(self) -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels.BLOCKS if self._launcher.is_parallel else kernels.TILES, kernels]

    def splats(
        self,
        scene: DeviceScene,
        drawn: DrawnSplats,
        pixels: PixelData,
        gradient: PixelGradient,
        name: str = "backward.splats",
    ) -> DeviceArray:
        """Returns the gradients (``SplatGradient``) of all splats of a frame; undefined for splats that cover no tile.

        Args:
            scene: The scene on the device, as it was drawn.
            drawn: The splats of the frame.
            pixels: Colours and alphas of the pixels.
            gradient: Gradients with respect to the colours and alphas of the pixels.
            name: Name of the result's buffer.
        """
        run, get, tiles = self._launcher.run_banded, self._buffers.get, math.prod(scene.tile_grid)
        count = drawn.splats.count
        starts = pair_starts(self._launcher, self._buffers, drawn.splats.rects, drawn.tiles.starts)
        pairs = get("backward.pairs", SplatGradient, drawn.tiles.items.shape[0])
        lists = (drawn.splats.data, drawn.splats.rects, starts, drawn.tiles.starts, drawn.tiles.items)
        inputs = (scene.camera, drawn.settings, *lists, drawn.meshes, pixels, gradient, pairs)
        with self._launcher.stage("backward: pixels"):
            if self._launcher.is_parallel:
                self._launcher.run_blocks(kernels.backward_blocks, tiles, *inputs)
            else:
                bands = TILE_BANDS_PER_THREAD * self._launcher.threads
                run(kernels.backward_tiles, tiles, *inputs, bands=bands)
        sums = get(name, SplatGradient, count)
        with self._launcher.stage("backward: splats"):
            run(kernels.add_pairs, count, starts, pairs, sums)
        return sums

    def gaussians(self, scene: DeviceScene, drawn: DrawnSplats, by_splat: DeviceArray, number: int) -> GaussianGradient:
        """Returns the gradients of the Gaussians of an asset; 0 for Gaussians that cover no tile.

        Args:
            scene: As for ``splats``.
            drawn: As for ``splats``.
            by_splat: Gradients of the splats.
            number: Index of the asset in the scene.
        """
        asset = scene.assets[number]
        out = gradient_of_asset(self._buffers, asset, number)
        data = (asset.instance_ids, asset.data, drawn.splats.data, drawn.splats.rects, by_splat)
        inputs = (scene.camera, drawn.settings, scene.splat_instances, *data, out)
        with self._launcher.stage("backward: Gaussians"):
            self._launcher.run_banded(kernels.backward_gaussians, asset.gaussians.count, *inputs)
        return out

    def pose(self, scene: DeviceScene, drawn: DrawnSplats, by_splat: DeviceArray, number: int) -> DeviceArray:
        """Returns what one splat instance contributes to the gradient by the camera pose, as rows for `PoseSums.of`.

        Args:
            scene: As for ``splats``.
            drawn: As for ``splats``.
            by_splat: Gradients of the splats.
            number: Index of the instance in the scene.
        """
        asset = next(asset for asset in scene.assets if number in asset.instances)
        chunks = -(-asset.gaussians.count // POSE_CHUNK)
        sums = self._buffers.get("backward.pose", PoseGradient, chunks)
        data = (number, asset.data, drawn.splats.data, drawn.splats.rects, by_splat)
        inputs = (scene.camera, drawn.settings, scene.splat_instances, *data, sums)
        self._launcher.run_banded(kernels.backward_pose, chunks, *inputs)
        return sums
