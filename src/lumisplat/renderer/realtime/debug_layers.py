"""Host pass: debug layers, which draw the motion of surfaces and the state that real time carries from frame to frame.

Each is an image of one vec3 a ray of the camera (docs/guide/outputs.md).
"""

from __future__ import annotations

import math

import warp as wp

from lumisplat.device.gi.radiance_cache import CacheSamples
from lumisplat.renderer.realtime import debug_layer_kernels as kernels
from lumisplat.renderer.realtime.gbuffer import PixelSurfaces
from lumisplat.renderer.realtime.radiance_cache import RadianceCache
from lumisplat.renderer.realtime.screen_probes import ScreenProbes
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher

_EMPTY = {"motion": math.nan, "history": 0.0, "cache": 0.0}
"""Value of pixels without data; -1 in the other layers."""


class DebugLayers:
    """Draws debug layers."""

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    @staticmethod
    def modules() -> list[KernelModule]:
        """The kernel modules."""
        return [kernels]

    def empty(self, name: str, count: int) -> DeviceArray:
        """An image without data: 0, NaN for motion, -1 for numbers of things."""
        image = self._image(name, count)
        image.fill_(_EMPTY.get(name, -1.0))
        return image

    def motion(self, scene: DeviceScene, surfaces: list[PixelSurfaces], count: int) -> DeviceArray:
        """Motion of each pixel's larger surface since the last frame, pixels; NaN where it is unknown."""
        image, share = self.empty("motion", count), self._shares(count)
        for kind in surfaces:
            inputs = scene.camera, scene.motion.camera, kind.now, share, image
            self._launcher.run_banded(kernels.show_motion, count, *inputs)
        return image

    def history(
        self, scene: DeviceScene, surfaces: list[PixelSurfaces], frames: list[DeviceArray], count: int
    ) -> DeviceArray:
        """Frames in the history of direct light of each pixel's larger surface; ``frames`` are those of each kind."""
        image, share = self.empty("history", count), self._shares(count)
        for kind, of_kind in zip(surfaces, frames, strict=True):
            self._launcher.run_banded(kernels.show_history, count, scene.camera, kind.now, of_kind, share, image)
        return image

    def probes(self, scene: DeviceScene, probes: ScreenProbes, count: int) -> DeviceArray:
        """How often the probe at a pixel has been refreshed; -1 where there is none."""
        image = self.empty("probes", count)
        self._launcher.run_banded(kernels.show_probes, probes.count, scene.camera, probes.probes, image)
        return image

    def cache(self, scene: DeviceScene, cache: RadianceCache, surfaces: list[PixelSurfaces], count: int) -> DeviceArray:
        """Radiance of the cache at each pixel's larger surface."""
        image = self._image("cache", count)
        image.assign(cache.look_up(self._samples(scene, surfaces, count)))
        return image

    def cache_cells(
        self, scene: DeviceScene, cache: RadianceCache, surfaces: list[PixelSurfaces], count: int
    ) -> DeviceArray:
        """Numbers of the cache's cells at these surfaces."""
        image, numbers = self._image("cache_cells", count), cache.cell_numbers(self._samples(scene, surfaces, count))
        self._launcher.run_banded(kernels.show_cells, count, numbers, image)
        return image

    def _samples(self, scene: DeviceScene, surfaces: list[PixelSurfaces], count: int) -> CacheSamples:
        """Each pixel's larger surface as a query of the cache."""
        samples, run = self._buffers.struct("debug.samples", CacheSamples, count), self._launcher.run_banded
        for number, kind in enumerate(surfaces):
            run(kernels.list_surfaces, count, scene.camera, kind.now, number == 0, samples)
        run(kernels.measure_distances, count, samples)
        return samples

    def _shares(self, count: int) -> DeviceArray:
        """Zeroed share of each pixel that the surface drawn so far covers."""
        share = self._buffers.get("debug.share", wp.float32, count)
        share.zero_()
        return share

    def _image(self, name: str, count: int) -> DeviceArray:
        return self._buffers.get(f"debug.{name}", wp.vec3, count)
