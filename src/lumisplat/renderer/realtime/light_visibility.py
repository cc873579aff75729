"""Visibility of lights at the surfaces of pixels, remembered from frame to frame.

The method is in docs/method/realtime.md#visibility.
"""

from __future__ import annotations

from typing import Any, cast

import warp as wp

from lumisplat.config import FilterConfig
from lumisplat.constants import SHADE_BANDS_PER_THREAD
from lumisplat.device.gi.light_visibility import LightVisibility, VisibilitySample
from lumisplat.device.gi.surfaces import KnownLight, PixelLight
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.realtime import light_visibility_kernels as kernels
from lumisplat.renderer.realtime.gbuffer import PixelSurfaces
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Kernel, KernelModule, Launcher

COUNT_MOST = 255.0
"""Largest number of samples that is counted."""


class LightVisibilities:
    """Remembers the visibility of each light at splat surfaces or mesh surfaces of pixels, and lights them by it.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings of the filters.
        kind: SPLATS (0) or MESHES (1).
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: FilterConfig, kind: int) -> None:
        self._launcher, self._buffers, self._config, self._kind = launcher, buffers, config, kind
        self._lights: dict[int, int] = {}
        """Number of lights in the last even frame (0) and in the last odd one (1)."""

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def reset(self) -> None:
        """Forgets all visibilities."""
        self._lights.clear()

    def lights_before(self, parity: int) -> int:
        """Returns the number of lights that the frame before one of this parity has stored; 0: no history."""
        return self._lights.get(1 - parity, 0)

    def begin_frame(self, lights: int, parity: int) -> None:
        """Begins a frame with this number of lights, on the host also where a CUDA graph is replayed."""
        self._lights[parity] = lights

    def fetch(self, scene: DeviceScene, surfaces: PixelSurfaces, parity: int) -> LightVisibility:
        """Returns the visibilities of lights at surfaces, from where these were in the frame before."""
        lights, lights_before = self._lights[parity], self.lights_before(parity)
        found = self._visibility(f"{self._kind}.reprojected", scene.image_size, lights)
        size = scene.motion.size_before
        before = self._visibility(f"{self._kind}.{1 - parity}", size, lights_before or lights)
        if lights_before == 0:
            cast(DeviceArray, before.counts).zero_()
        motion, (width, height) = scene.motion, scene.image_size
        moved = self._buffers.get(f"visibility.{self._kind}.moved", wp.int32, width * height)
        inputs = motion.light_before, motion.light_kept, motion.moved_boxes, surfaces.now, surfaces.reprojection
        inputs = *inputs, motion.sequence, scene.shading, before, found, moved
        self._run(scene, kernels.reproject_visibility, *inputs)
        return found

    def update(
        self,
        scene: DeviceScene,
        surfaces: PixelSurfaces,
        light: PixelLight,
        rays: RayData,
        *,
        visibility: DeviceArray,
        before: LightVisibility,
        parity: int,
    ) -> LightVisibility:
        """Adds the samples of a frame of this parity to the visibilities ``before``; returns them smoothed.

        ``visibility`` holds that of the shadow ``rays`` of ``light``.
        """
        width, height = scene.image_size
        sample = self._buffers.struct("visibility.sample", VisibilitySample, width * height)
        inputs = self._kind, scene.camera, light, rays, visibility, sample
        self._launcher.run_banded(kernels.store_visibility, len(rays.t_max), *inputs)
        lights = self._lights[parity]
        now = self._visibility(f"{self._kind}.{parity}", scene.image_size, lights)
        inputs = min(float(self._config.frames), COUNT_MOST), surfaces.now, scene.camera
        partial = self._buffers.get("visibility.partial", wp.int32, width * height)
        moved = self._buffers.get(f"visibility.{self._kind}.moved", wp.int32, width * height)
        inputs = *inputs, scene.shading, moved, sample, before, now, partial
        self._run(scene, kernels.update_visibility, *inputs)
        return self._smooth(scene, surfaces, now, partial, lights)

    def _smooth(
        self,
        scene: DeviceScene,
        surfaces: PixelSurfaces,
        visibility: LightVisibility,
        partial: DeviceArray,
        lights: int,
    ) -> LightVisibility:
        """Averages partial visibilities with those of neighbouring pixels, in passes of doubling pixel distance."""
        width, height = scene.image_size
        for number in range(self._config.passes):
            smoothed = LightVisibility()
            packed = self._buffers.get(f"visibility.pass{number % 2}", wp.uint64, width * height * lights)
            smoothed.packed = cast(Any, packed.reshape((width * height, lights)))
            smoothed.counts = visibility.counts
            inputs = 2**number, surfaces.now, scene.camera, partial, visibility, smoothed
            self._run(scene, kernels.filter_visibility, *inputs)
            visibility = smoothed
        return visibility

    def add(
        self,
        scene: DeviceScene,
        wave: RayWave,
        surfaces: PixelSurfaces,
        visibility: LightVisibility,
        *,
        known: KnownLight,
        layers: tuple[DeviceArray, DeviceArray],
        no_shadows: bool,
    ) -> None:
        """Adds the light whose visibility is remembered to camera rays, ``known``, and diffuse and glossy layers."""
        inputs = no_shadows, self._kind, scene.camera, scene.shading, wave.data, visibility
        inputs = *inputs, surfaces.now, known, *layers
        bands = SHADE_BANDS_PER_THREAD * self._launcher.threads
        self._launcher.run_banded(kernels.add_remembered_light, wave.count, *inputs, bands=bands)

    def _visibility(self, name: str, size: tuple[int, int], lights: int) -> LightVisibility:
        width, height = size
        found, shape = LightVisibility(), (width * height, lights)
        for field, dtype in (("packed", wp.uint64), ("counts", wp.uint8)):
            array = self._buffers.get(f"visibility.{name}.{field}", dtype, width * height * lights)
            setattr(found, field, array.reshape(shape))
        return found

    def _run(self, scene: DeviceScene, kernel: Kernel, *inputs: object) -> None:
        width, height = scene.image_size
        bands = SHADE_BANDS_PER_THREAD * self._launcher.threads
        self._launcher.run_banded(kernel, width * height, wp.vec2i(width, height), *inputs, bands=bands)
