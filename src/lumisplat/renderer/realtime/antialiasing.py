"""Temporal antialiasing of frames with jittered samples (docs/method/realtime.md#antialiasing)."""

from __future__ import annotations

import warp as wp

from lumisplat.constants import SHADE_BANDS_PER_THREAD
from lumisplat.device.gi.surfaces import KnownLight, TemporalHistory, TemporalPixels
from lumisplat.renderer.realtime import antialiasing_kernels as kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import Kernel, KernelModule, Launcher


class Antialiasing:
    """Averages each pixel's colours and layers over frames; earlier frames are reprojected along the pixel's motion."""

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self.has_history = False
        """True if an earlier frame of the sequence has images."""

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def reset(self) -> None:
        """Drops the images averaged over earlier frames."""
        self.has_history = False

    def average(
        self,
        scene: DeviceScene,
        plan: FramePlan,
        wave: RayWave,
        layers: dict[str, DeviceArray],
        *,
        known: tuple[KnownLight, KnownLight],
        frame: int,
    ) -> None:
        """Replaces the camera rays' radiance, and the layers that the plan requests, by means over frames.

        Radiance and layers are averaged with equal weights. ``known`` is the known light of the previous frame and of
        this one.
        """
        width, height = scene.image_size
        size, radiance = wp.vec2i(width, height), wave.row.radiance
        pixels = self._buffers.struct("antialiasing.pixels", TemporalPixels, width * height)
        shares = self._buffers.get("antialiasing.shares", wp.vec3, wave.count)
        sizes = (frame - 1, scene.motion.size_before), (frame, scene.image_size)
        before, now = (self._history(*number) for number in sizes)
        if not self.has_history:
            device_array(before.frames).zero_()
        self.has_history = True
        motion = scene.motion
        inputs = scene.camera, motion.camera, scene.shading, scene.gaussians, motion.splats, motion.meshes
        self._run(kernels.store_pixels, wave.count, *inputs, wave.data, pixels, shares)
        inputs = size, motion.sequence, motion.moved_to, *known, before, pixels, now
        self._run(kernels.weight_history, width * height, *inputs)
        indirect = layers["indirect_diffuse"]
        images = {"captured": radiance.captured, "light": radiance.light, "shares": shares}
        images |= {name: image for name, image in layers.items() if name in plan.aovs or image is indirect}
        images |= {"capture_factor": radiance.capture_factor} if plan.has_shadow_catchers else {}
        self._run(kernels.add_image, wave.count, -1.0, indirect, radiance.light)
        for name, image in images.items():
            means = [self._mean(name, *number) for number in sizes]
            parts = name in ("light", "direct_diffuse"), name in ("light", "direct_glossy")
            parts = *parts, image is indirect
            inputs = motion.sequence, scene.camera, pixels, *parts, *known, means[0], image, means[1]
            self._run(kernels.blend, wave.count, *inputs)
        self._run(kernels.add_image, wave.count, 1.0, indirect, radiance.light)
        self._run(kernels.store_shares, wave.count, scene.camera, shares, wave.data)

    def _run(self, kernel: Kernel, count: int, *inputs: object) -> None:
        bands = SHADE_BANDS_PER_THREAD * self._launcher.threads
        self._launcher.run_banded(kernel, count, *inputs, bands=bands)

    def _history(self, frame: int, size: tuple[int, int]) -> TemporalHistory:
        width, height = size
        return self._buffers.struct(f"antialiasing.history{frame % 2}", TemporalHistory, width * height)

    def _mean(self, name: str, frame: int, size: tuple[int, int]) -> DeviceArray:
        width, height = size
        return self._buffers.get(f"antialiasing.{name}{frame % 2}", wp.vec3, width * height)
