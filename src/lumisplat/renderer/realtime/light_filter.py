"""Spatiotemporal denoiser of the light at surfaces (SVGF, Schied et al. 2017)."""

from __future__ import annotations

import warp as wp

from lumisplat.config import FilterConfig
from lumisplat.constants import SHADE_BANDS_PER_THREAD
from lumisplat.device.gi.surfaces import FilteredLight, LightHistory, SurfaceLight
from lumisplat.renderer.realtime import light_filter_kernels as kernels
from lumisplat.renderer.realtime.gbuffer import PixelSurfaces
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import Kernel, KernelModule, Launcher


class LightFilter:
    """Denoises the light on splat surfaces, or on mesh surfaces, frame by frame.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        name: Name of the buffers that hold the means over earlier frames.
        shared: Number of pixels that share each light sample, and therefore its noise.
        lobe_widths: Width of the averages of glossy light, in widths of the highlight.
        is_indirect: Whether the light is indirect: while light changes, its means cover few frames.
    """

    def __init__(
        self,
        launcher: Launcher,
        buffers: Buffers,
        config: FilterConfig,
        name: str,
        *,
        shared: int,
        lobe_widths: float,
        is_indirect: bool,
    ) -> None:
        self._launcher, self._buffers, self._config, self._name = launcher, buffers, config, name
        self._shared, self._lobe_widths, self._is_indirect = float(shared), lobe_widths, is_indirect
        self.has_history = False
        """True if an earlier frame of the sequence has light."""

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def reset(self) -> None:
        """Drops the light averaged over earlier frames."""
        self.has_history = False

    def filter(self, scene: DeviceScene, surfaces: PixelSurfaces, light: SurfaceLight, frame: int) -> FilteredLight:
        """Denoises a frame's light samples on ``surfaces`` over frames and neighbouring pixels; returns the light."""
        with self._launcher.stage("accumulate"):
            history = self._accumulate(scene, surfaces, light, frame)
        with self._launcher.stage("filter"):
            return self._smooth(scene, surfaces, history)

    def frames(self, scene: DeviceScene, frame: int) -> DeviceArray:
        """Returns, for each pixel, the number of frames that its mean light averages, as float."""
        return device_array(self._history(scene.image_size, frame).frames)

    def _accumulate(self, scene: DeviceScene, surfaces: PixelSurfaces, light: SurfaceLight, frame: int) -> LightHistory:
        """Reprojects the means of earlier frames, and adds the light samples of this frame."""
        before, now = self._history(scene.motion.size_before, frame - 1), self._history(scene.image_size, frame)
        if not self.has_history:
            device_array(before.frames).zero_()
        self.has_history = True
        found = self._buffers.struct("filter.history", LightHistory, len(now.frames))
        sequence = scene.motion.sequence
        self._run(scene, kernels.reproject, surfaces.now, surfaces.reprojection, sequence, before, found)
        inputs = float(self._config.frames), self._shared, self._is_indirect, sequence
        self._run(scene, kernels.accumulate, *inputs, surfaces.now, scene.camera, light, found, now)
        return now

    def _smooth(self, scene: DeviceScene, surfaces: PixelSurfaces, history: LightHistory) -> FilteredLight:
        """Averages each pixel's light with its neighbours', in passes of doubling pixel distance (a-trous wavelets)."""
        light = FilteredLight()
        light.diffuse, light.glossy = history.diffuse, history.glossy
        light.deviation = self._buffers.get("filter.deviation", wp.vec2, len(history.frames))
        inputs = surfaces.now, scene.camera, self._is_indirect, scene.motion.sequence, history
        self._run(scene, kernels.estimate_deviation, *inputs, light.deviation)
        for number in range(self._config.passes):
            is_last = number == self._config.passes - 1
            name = f"{self._name}.filtered" if is_last else f"filter.pass{number % 2}"
            filtered = self._buffers.struct(name, FilteredLight, len(history.frames))
            inputs = self._config.radius, 2**number, self._lobe_widths, surfaces.now, scene.camera
            self._run(scene, kernels.filter_pass, *inputs, history.frames, light, filtered)
            light = filtered
        return light

    def _run(self, scene: DeviceScene, kernel: Kernel, *inputs: object) -> None:
        width, height = scene.image_size
        bands = SHADE_BANDS_PER_THREAD * self._launcher.threads
        self._launcher.run_banded(kernel, width * height, wp.vec2i(width, height), *inputs, bands=bands)

    def _history(self, size: tuple[int, int], frame: int) -> LightHistory:
        width, height = size
        return self._buffers.struct(f"{self._name}.history{frame % 2}", LightHistory, width * height)
