"""Follows reflected and refracted rays bounce by bounce.

A wave is all rays after the same number of bounces; the rays that leave its smooth surfaces form the next wave.
Radiance is gathered from the last wave to the first, so that each array element is written by one thread, and the
result does not depend on the number of threads.

A CUDA graph contains the waves with the capacities that an earlier sample needed. A sample that needs more is cut, and
must be drawn again (`SpecularWaves.finish`).

The equations are in docs/method/materials.md#smooth-surfaces.
"""

from __future__ import annotations

import warp as wp

from lumisplat.constants import BOUNCES_MAX
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace import specular_wave_kernels as kernels
from lumisplat.renderer.trace.ray_wave import CarriedState, RayWave
from lumisplat.runtime.buffers import Buffers, device_array, grown_capacity
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import copy_elements, prefix_sum


class SpecularWaves:
    """Starts the rays of the next bounce, and adds the radiance of these rays to their parent rays.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._rays = self._growth = 0
        self._capacities: list[int] = []
        """Number of rays allocated for each wave after the first, up to the first wave that has none."""
        self._counts = buffers.get("wave.counts", wp.int32, BOUNCES_MAX)
        """Number of rays of each wave after the first in the current sample, as far as the waves were traced."""

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    @property
    def graph_key(self) -> object:
        """Capacities of the waves, which a CUDA graph of them contains; another one is stale."""
        return tuple(self._capacities), self._growth

    def number(self, wave: RayWave) -> None:
        """Assigns consecutive indices in the next wave to the reflected and refracted rays that leave a wave."""
        if wave.number == 0:
            self._counts.zero_()  # an earlier sample may have followed more waves
        prefix_sum(device_array(wave.row.branches), device_array(wave.row.branch_ends), inclusive=True)

    def capacity(self, wave: RayWave) -> int:
        """Returns how many rays to allocate for the next wave; 0 if it has none.

        The host waits until the device has counted the rays; not while it records a CUDA graph, which gets the
        capacities of the last sample that was drawn without a graph. Sizes are rounded up to a few capacities, so that
        buffers are reused.
        """
        ends = device_array(wave.row.branch_ends)[-1:]
        if not self._launcher.is_parallel:
            return grown_capacity(int(ends.numpy()[0]))
        copy_elements(ends, self._counts[wave.number : wave.number + 1], 1)
        if not self._launcher.is_recording:
            self._learn(wave, grown_capacity(int(ends.numpy()[0])))
        return self._capacities[wave.number]

    def finish(self) -> bool:
        """Waits for the waves; False if one had more rays than its capacity. Then draw the sample again.

        It is then drawn without a graph, because `graph_key` has changed, and the capacities grow.
        """
        if not self._launcher.is_parallel:
            return True
        complete = bool((self._counts.numpy()[: len(self._capacities)] <= self._capacities).all())
        self._growth += not complete
        return complete

    def _learn(self, wave: RayWave, capacity: int) -> None:
        """Stores the capacity that the rays which leave ``wave`` need; capacities of an image size only grow."""
        known = self._capacities
        if wave.number == 0 and wave.count != self._rays:
            self._rays = wave.count
            known.clear()
        if wave.number == len(known):
            known.append(capacity)
        known[wave.number] = max(known[wave.number], capacity)

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
