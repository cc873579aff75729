"""Host pass: images of how surfaces have moved, and of what frames in real time keep for the next one."""

from __future__ import annotations

import math

import warp as wp

from lumisplat.device.structs.radiance_cache import CacheSamples
from lumisplat.renderer.gi.radiance_cache import RadianceCache
from lumisplat.renderer.gi.screen_probes import ScreenProbes
from lumisplat.renderer.realtime import kept_kernels as kernels
from lumisplat.renderer.realtime.gbuffer import Surfaces
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher

_NOTHING = {"motion": math.nan, "history": 0.0, "cache": 0.0}


class Kept:
    """Draws images, an element of vec3 a ray of the camera each.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the images.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    @staticmethod
    def modules() -> list[KernelModule]:
        """The kernel modules."""
        return [kernels]

    def nothing(self, name: str, count: int) -> DeviceArray:
        """The image of a frame that keeps no such thing: 0, NaN for motion, or -1 where there are numbers of things."""
        image = self._image(name, count)
        image.fill_(_NOTHING.get(name, -1.0))
        return image

    def motion(self, scene: DeviceScene, surfaces: list[Surfaces], count: int) -> DeviceArray:
        """How surfaces have moved, of two that of the one that is more of the pixel; NaN: that is not known.

        Args:
            scene: The scene on the device, with the camera of the frame before.
            surfaces: What the pixels show, by kinds.
            count: Number of rays.
        """
        image, share = self.nothing("motion", count), self._shares(count)
        for kind in surfaces:
            inputs = scene.camera, scene.motion.camera, kind.now, share, image
            self._launcher.run_banded(kernels.show_motion, count, *inputs)
        return image

    def history(
        self, scene: DeviceScene, surfaces: list[Surfaces], frames: list[DeviceArray], count: int
    ) -> DeviceArray:
        """Frames in the history of direct light; of two surfaces that of the one that is more of the pixel.

        Args:
            scene: The scene on the device.
            surfaces: What the pixels show, by kinds.
            frames: In their histories.
            count: Number of rays.
        """
        image, share = self.nothing("history", count), self._shares(count)
        for kind, of_kind in zip(surfaces, frames, strict=True):
            self._launcher.run_banded(kernels.show_history, count, scene.camera, kind.now, of_kind, share, image)
        return image

    def probes(self, scene: DeviceScene, probes: ScreenProbes, count: int) -> DeviceArray:
        """How often the probe at a pixel has been refreshed; -1: none is there."""
        image = self.nothing("probes", count)
        self._launcher.run_banded(kernels.show_probes, probes.count, scene.camera, probes.probes, image)
        return image

    def cache(self, scene: DeviceScene, cache: RadianceCache, surfaces: list[Surfaces], count: int) -> DeviceArray:
        """What the cache has where the surfaces of pixels are."""
        image = self._image("cache", count)
        image.assign(cache.look_up(self._listed(scene, surfaces, count)))
        return image

    def cache_cells(
        self, scene: DeviceScene, cache: RadianceCache, surfaces: list[Surfaces], count: int
    ) -> DeviceArray:
        """Numbers of the cells where they are."""
        image, numbers = self._image("cache_cells", count), cache.cell_numbers(self._listed(scene, surfaces, count))
        self._launcher.run_banded(kernels.show_cells, count, numbers, image)
        return image

    def _listed(self, scene: DeviceScene, surfaces: list[Surfaces], count: int) -> CacheSamples:
        """The surfaces as the cache is asked for them."""
        samples, run = self._buffers.struct("kept.samples", CacheSamples, count), self._launcher.run_banded
        for number, kind in enumerate(surfaces):
            run(kernels.list_surfaces, count, scene.camera, kind.now, number == 0, samples)
        run(kernels.place_eye, count, samples)
        return samples

    def _shares(self, count: int) -> DeviceArray:
        """Of pixels, that the surfaces have which an image shows: none yet."""
        share = self._buffers.get("kept.share", wp.float32, count)
        share.zero_()
        return share

    def _image(self, name: str, count: int) -> DeviceArray:
        return self._buffers.get(f"kept.{name}", wp.vec3, count)
