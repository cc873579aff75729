"""Host pass: from wave to wave, by way of mirrors and glass.

Rays go out in waves: those that leave the smooth surfaces of one wave are the next. Colours come back the other way,
from the last wave to the first, so that every element is written by one item, whatever the number of threads.

The equations are in docs/method/materials.md#smooth-surfaces.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.integrators import specular_wave_kernels as kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, grown_capacity
from lumisplat.runtime.launcher import Launcher


class SpecularWaves:
    """Spawns the rays of the next wave, and gathers what they see.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    def count(self, wave: RayWave) -> int:
        """How many rays go on; the host waits for it, so that such a frame cannot be captured as a graph."""
        wp.utils.array_scan(wave.row.branches, wave.row.branch_ends, inclusive=True)
        return int(wave.row.branch_ends[-1:].numpy()[0])

    def spawn(self, scene: DeviceScene, wave: RayWave, count: int) -> tuple[RayData, Any]:
        """The ``count`` rays that go on from a wave, and their weights; writes the path weights of the next wave."""
        number = wave.number + 1
        capacity = grown_capacity(count)  # a few sizes of arrays instead of one a frame
        rays = self._buffers.struct(f"wave.rays{number % 2}", RayData, capacity)
        rays.is_active.fill_(False)
        weights = self._buffers.get(f"wave.{number}.weights", wp.vec3, capacity)
        path_weights = self._buffers.get(f"wave.path_weights{number % 2}", wp.float32, capacity)
        self._launcher.run_banded(
            kernels.spawn_rays,
            wave.row.branches.shape[0],
            *(scene.shading, wave.data, rays, weights, path_weights),
        )
        return rays, weights

    def gather(self, scene: DeviceScene, near: RayWave, far: RayWave) -> None:
        """Adds what the rays of a wave see to what those see that they branch off."""
        self._launcher.run_banded(kernels.gather_branches, near.count, scene.shading, far.data, near.data)
