"""Host pass: rays within the highlights of what pixels show (docs/method/realtime.md#glossy)."""

from __future__ import annotations

import warp as wp

from lumisplat.device.structs.gi import LobeRays
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.gi import lobe_kernels as kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, device_array, grown_capacity
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import prefix_sum


class Lobes:
    """Chooses and starts the rays.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        follows: Whether there are any.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, *, follows: bool) -> None:
        self._launcher, self._buffers, self._follows = launcher, buffers, follows

    @staticmethod
    def modules() -> list[KernelModule]:
        """The kernel modules."""
        return [kernels]

    def start(self, scene: DeviceScene, wave: RayWave, frame: int) -> tuple[LobeRays, RayData | None]:
        """The rays of a frame, and what they are for; None: there are none. The host waits for their number.

        Args:
            scene: The scene on the device.
            wave: The first wave; later ones overwrite its surfaces.
            frame: Number of the frame.
        """
        width, height = scene.image_size
        squares = -(-width // 2) * -(-height // 2)
        run = self._launcher.run_banded
        lobes = self._buffers.struct("lobes", LobeRays, squares, without={"seen"})
        if not self._follows:
            device_array(lobes.slot).fill_(-1)
            return lobes, None
        follows, ends = (self._buffers.get(f"lobes.{name}", wp.int32, squares) for name in ("follows", "ends"))
        run(kernels.choose_lobes, squares, frame, scene.camera, wave.data, lobes, follows)
        prefix_sum(follows, ends, inclusive=True)
        count = int(device_array(ends)[-1:].numpy()[0])
        if count == 0:
            return lobes, None
        rays = self._buffers.struct("lobes.rays", RayData, grown_capacity(count))
        rays.is_active.zero_()
        run(kernels.start_lobes, squares, scene.camera, wave.data, ends, lobes, rays)
        return lobes, rays
