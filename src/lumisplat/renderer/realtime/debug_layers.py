"""Host pass: debug layers, which draw the motion of surfaces and the state that real time carries from frame to frame.

Each is an image of one vec3 a ray of the camera (docs/guide/outputs.md).
"""

from __future__ import annotations

import math

import warp as wp

from lumisplat.device.gi.radiance_cache import CacheSamples
from lumisplat.device.gi.surfaces import SurfacePixels
from lumisplat.renderer.realtime import debug_layer_kernels as kernels
from lumisplat.renderer.realtime.gbuffer import MESHES, SPLATS, PixelSurfaces
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
        image = self.empty("motion", count)
        inputs = scene.camera, scene.motion.camera, *_kinds(surfaces), image
        self._launcher.run_banded(kernels.draw_motion, count, *inputs)
        return image

    def history(
        self, scene: DeviceScene, surfaces: list[PixelSurfaces], frames: dict[int, DeviceArray], count: int
    ) -> DeviceArray:
        """Frames in the history of direct light of each pixel's larger surface; ``frames`` are those of each kind."""
        image = self.empty("history", count)
        inputs = scene.camera, *_kinds(surfaces), frames.get(SPLATS), frames.get(MESHES), image
        self._launcher.run_banded(kernels.draw_history, count, *inputs)
        return image

    def probes(self, scene: DeviceScene, probes: ScreenProbes, count: int) -> DeviceArray:
        """How often the probe at a pixel has been refreshed; -1 where there is none."""
        image = self.empty("probes", count)
        self._launcher.run_banded(kernels.draw_probes, probes.count, scene.camera, probes.probes, image)
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
        self._launcher.run_banded(kernels.draw_cells, count, numbers, image)
        return image

    def _samples(self, scene: DeviceScene, surfaces: list[PixelSurfaces], count: int) -> CacheSamples:
        """Each pixel's larger surface as a query of the cache."""
        samples = self._buffers.struct("debug.samples", CacheSamples, count)
        self._launcher.run_banded(kernels.list_surfaces, count, scene.camera, *_kinds(surfaces), samples)
        return samples

    def _image(self, name: str, count: int) -> DeviceArray:
        return self._buffers.get(f"debug.{name}", wp.vec3, count)


def _kinds(surfaces: list[PixelSurfaces]) -> tuple[SurfacePixels, SurfacePixels]:
    """Surfaces of Gaussians and of meshes; without elements if the scene has none."""
    of_kind = {each.kind: each.now for each in surfaces}
    return of_kind.get(SPLATS, SurfacePixels()), of_kind.get(MESHES, SurfacePixels())
