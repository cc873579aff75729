"""Draws debug layers, which show the motion of surfaces and the state reused from frame to frame.

Each layer is an image with one vec3 for each camera ray (docs/guide/image_layers.md).
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
"""Value of pixels without data in each debug layer; layers that are not listed have -1."""


class DebugLayers:
    """Draws the debug layers of real-time frames: motion, history, probes, cache and cache_cells."""

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def empty(self, name: str, count: int) -> DeviceArray:
        """Returns a layer without data: NaN for motion, 0 for history and cache, -1 for counts and cell numbers."""
        image = self._image(name, count)
        image.fill_(_EMPTY.get(name, -1.0))
        return image

    def motion(self, scene: DeviceScene, surfaces: list[PixelSurfaces], count: int) -> DeviceArray:
        """Draws the motion since the previous frame, in pixels, of the surface that covers most of each pixel.

        NaN: the surface is new, so its motion is unknown.
        """
        image = self.empty("motion", count)
        inputs = scene.camera, scene.motion.camera, *_kinds(surfaces), image
        self._launcher.run_banded(kernels.draw_motion, count, *inputs)
        return image

    def history(
        self, scene: DeviceScene, surfaces: list[PixelSurfaces], frames: dict[int, DeviceArray], count: int
    ) -> DeviceArray:
        """Draws the number of frames averaged into direct light at the surface that covers most of each pixel.

        ``frames`` holds these numbers for splat surfaces (SPLATS) and mesh surfaces (MESHES).
        """
        image = self.empty("history", count)
        inputs = scene.camera, *_kinds(surfaces), frames.get(SPLATS), frames.get(MESHES), image
        self._launcher.run_banded(kernels.draw_history, count, *inputs)
        return image

    def probes(self, scene: DeviceScene, probes: ScreenProbes, count: int) -> DeviceArray:
        """Draws the number of updates of the screen probe at a pixel; -1 where a pixel has no probe."""
        image = self.empty("probes", count)
        self._launcher.run_banded(kernels.draw_probes, probes.count, scene.camera, probes.probes, image)
        return image

    def cache(self, scene: DeviceScene, cache: RadianceCache, surfaces: list[PixelSurfaces], count: int) -> DeviceArray:
        """Draws the radiance that the radiance cache holds at the surface that covers most of each pixel."""
        image = self._image("cache", count)
        image.assign(cache.look_up(self._samples(scene, surfaces, count)))
        return image

    def cache_cells(
        self, scene: DeviceScene, cache: RadianceCache, surfaces: list[PixelSurfaces], count: int
    ) -> DeviceArray:
        """Draws the identifying number of the radiance-cache cell at the surface that covers most of each pixel."""
        image, numbers = self._image("cache_cells", count), cache.cell_numbers(self._samples(scene, surfaces, count))
        self._launcher.run_banded(kernels.draw_cells, count, numbers, image)
        return image

    def _samples(self, scene: DeviceScene, surfaces: list[PixelSurfaces], count: int) -> CacheSamples:
        """Returns the surface that covers most of each pixel, as a query of the radiance cache."""
        samples = self._buffers.struct("debug.samples", CacheSamples, count)
        self._launcher.run_banded(kernels.list_surfaces, count, scene.camera, *_kinds(surfaces), samples)
        return samples

    def _image(self, name: str, count: int) -> DeviceArray:
        return self._buffers.get(f"debug.{name}", wp.vec3, count)


def _kinds(surfaces: list[PixelSurfaces]) -> tuple[SurfacePixels, SurfacePixels]:
    """Returns the pixels' splat surfaces and mesh surfaces; those that the scene lacks have empty arrays."""
    of_kind = {each.kind: each.now for each in surfaces}
    return of_kind.get(SPLATS, SurfacePixels()), of_kind.get(MESHES, SurfacePixels())
