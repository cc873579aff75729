"""Host pass: derivatives of a loss by the Gaussians that rays of pixels have met, given those by the pixels."""

from __future__ import annotations

import math

from lumisplat.constants import TILE_BANDS_PER_THREAD
from lumisplat.device.gaussian.hit_gradient import RayMotion
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient, RaySplatGradient
from lumisplat.renderer.gradients import (
    ray_splat_backward_kernels,
    ray_splat_backward_warp_kernels,
    splat_backward_kernels,
)
from lumisplat.renderer.gradients.gaussian_gradient import gradient_of_asset
from lumisplat.renderer.gradients.splat_backward import starts_of_pairs
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.unscented.unscented_raster import SplatsOnRays
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher


class UnscentedBackward:
    """Goes back from pixels to the Gaussians that their rays have met.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    def modules(self) -> list[KernelModule]:
        """The kernel modules."""
        return [
            ray_splat_backward_kernels,
            splat_backward_kernels,
            *([ray_splat_backward_warp_kernels] if self._launcher.is_parallel else []),
        ]

    def splats(self, scene: DeviceScene, met: SplatsOnRays, pixels: PixelData, gradient: PixelGradient) -> DeviceArray:
        """Derivatives by all Gaussians of a frame, an element of ``RaySplatGradient`` each.

        Args:
            scene: The scene on the device, as it was drawn.
            met: What the rays have met.
            pixels: What came of it.
            gradient: Derivatives by these.
        """
        run, get, tiles = self._launcher.run_banded, self._buffers.get, math.prod(scene.tile_grid)
        count, starts = met.splats.count, self.pair_starts(met)
        pairs = get("backward.ray_pairs", RaySplatGradient, met.tiles.items.shape[0])
        lists = (met.splats.data, met.splats.rects, starts, met.tiles.starts, met.tiles.items)
        inputs = (scene.camera, met.settings, *lists, met.rays, met.limits, pixels, gradient, pairs)
        with self._launcher.stage("backward: pixels"):
            if self._launcher.is_parallel:
                self._launcher.run_blocks(ray_splat_backward_warp_kernels.backward_ray_warps, tiles, *inputs)
            else:
                bands = TILE_BANDS_PER_THREAD * self._launcher.threads
                run(ray_splat_backward_kernels.backward_ray_tiles, tiles, *inputs, bands=bands)
        sums = get("backward.ray_splats", RaySplatGradient, count)
        with self._launcher.stage("backward: splats"):
            run(ray_splat_backward_kernels.add_records, count, starts, pairs, sums)
        return sums

    def pair_starts(self, met: SplatsOnRays) -> DeviceArray:
        """Where the records of the tiles of each Gaussian begin; the last element is their number."""
        return starts_of_pairs(self._launcher, self._buffers, met.splats.rects, met.splats.count)

    def gaussians(self, scene: DeviceScene, met: SplatsOnRays, by_splat: DeviceArray, number: int) -> GaussianGradient:
        """Derivatives by the Gaussians of an asset, 0 for those that were not met.

        Args:
            scene: As of ``splats``.
            met: As of ``splats``.
            by_splat: Derivatives that ``splats`` has found.
            number: The asset's, in the scene.
        """
        asset = scene.assets[number]
        out = gradient_of_asset(self._buffers, asset, number)
        data = (asset.instance_ids, asset.data, met.splats.data, met.splats.rects, by_splat)
        motions = self._buffers.get("backward.motions", RayMotion, met.splats.count)
        inputs = (scene.camera, met.settings, scene.splat_instances, *data, motions, out)
        kernel = ray_splat_backward_kernels.backward_seen_gaussians
        with self._launcher.stage("backward: Gaussians"):
            self._launcher.run_banded(kernel, asset.gaussians.count, *inputs)
        return out

    def motions(self, met: SplatsOnRays) -> DeviceArray:
        """Derivatives by where the rays are that meet each Gaussian, ``RayMotion``; after ``gaussians`` of all assets.

        Args:
            met: As of ``splats``.
        """
        return self._buffers.get("backward.motions", RayMotion, met.splats.count)
