"""Follows reflected and refracted rays bounce by bounce.

A wave is all rays after the same number of bounces; the rays that leave its smooth surfaces form the next wave.
Radiance is gathered from the last wave to the first, so that each array element is written by one thread, and the
result does not depend on the number of threads.

The equations are in docs/method/materials.md#smooth-surfaces.
"""

from __future__ import annotations

import warp as wp

from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace import specular_wave_kernels as kernels
from lumisplat.renderer.trace.ray_wave import CarriedState, RayWave
from lumisplat.runtime.buffers import Buffers, device_array, grown_capacity
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import prefix_sum


class SpecularWaves:
    """Starts the rays of the next bounce, and adds the radiance of these rays to their parent rays.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def number(self, wave: RayWave) -> None:
        """Assigns consecutive indices in the next wave to the reflected and refracted rays that leave a wave."""
        prefix_sum(device_array(wave.row.branches), device_array(wave.row.branch_ends), inclusive=True)

    def capacity(self, wave: RayWave) -> int:
        """Returns how many rays to allocate for the next wave; 0 if it has none. Blocks until the device has counted.

        Sizes are rounded up to a few capacities, so that buffers are reused.
        """
        count = int(device_array(wave.row.branch_ends)[-1:].numpy()[0])
        return grown_capacity(count)

    def spawn(self, scene: DeviceScene, plan: FramePlan, wave: RayWave, capacity: int) -> tuple[RayData, CarriedState]:
        """Returns the rays of the next wave and the state that they inherit; also writes the rays' path weights."""
        number = wave.number + 1
        rays = self._buffers.struct(f"wave.rays{number % 2}", RayData, capacity)
        rays.is_active.zero_()
        weights = self._buffers.get(f"wave.{number}.weights", wp.vec3, capacity)
        path_weights = self._buffers.get(f"wave.path_weights{number % 2}", wp.float32, capacity)
        media = self._buffers.get(f"wave.media{number % 2}", wp.vec4i, capacity) if plan.has_media else None
        sees_environment = (
            self._buffers.get(f"wave.{number}.sees_environment", wp.bool, capacity) if plan.has_lobes else None
        )
        self._launcher.run_banded(
            kernels.spawn_rays,
            len(wave.row.branches),
            *(scene.shading, wave.data, rays, weights, path_weights, media, sees_environment),
        )
        return rays, CarriedState(weights, media, sees_environment)

    def gather(self, scene: DeviceScene, near: RayWave, far: RayWave) -> None:
        """Adds the radiance of rays of wave ``far`` to their parent rays, in the wave ``near`` before."""
        self._launcher.run_banded(kernels.gather_branches, near.count, scene.shading, far.data, near.data)
