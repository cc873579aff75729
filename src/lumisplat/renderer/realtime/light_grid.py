"""With many lights, chooses a few lights for each cell of a grid in world space.

The method is in docs/method/realtime.md#light-grid.
"""

from __future__ import annotations

import warp as wp

from lumisplat.constants import GRID_CELLS_MAX, GRID_LIGHTS, SHADE_BANDS_PER_THREAD
from lumisplat.device.gi.light_grid import LightGrid
from lumisplat.renderer.realtime import light_grid_kernels as kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import prefix_sum, sort_pairs


class LightGrids:
    """Chooses a few of many lights for each world-space grid cell that contains surfaces."""

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def is_needed(self, scene: DeviceScene) -> bool:
        """Returns whether the scene has more than `GRID_LIGHTS` lights; with fewer, surfaces sample all of them."""
        return scene.lights.choice_count > GRID_LIGHTS

    def of_wave(self, scene: DeviceScene, wave: RayWave) -> LightGrid:
        """Chooses lights for the grid cells of surfaces that a wave's rays hit; the grid is empty unless `is_needed`.

        The next call overwrites the result.
        """
        grid = LightGrid()
        if not self.is_needed(scene):
            return grid
        with self._launcher.stage("light grid"):
            keys, ends = self._sorted(scene, wave)
            count, run, get = wave.count, self._launcher.run_banded, self._get
            grid.cell_of = get("cell_of", wp.int32, count)
            cells = get("cells", wp.int64, count)
            run(kernels.list_cells, count, GRID_CELLS_MAX, keys, self._order(count), ends, grid.cell_of, cells)
            capacity = self._launcher.capacity_of(ends, GRID_CELLS_MAX)
            size = capacity * (GRID_LIGHTS + 1)
            grid.numbers, grid.chances = get("numbers", wp.int32, size), get("chances", wp.float32, size)
            bands = SHADE_BANDS_PER_THREAD * self._launcher.threads
            run(kernels.choose_lights, capacity, cells, ends, scene.shading, grid, bands=bands)
        return grid

    def _sorted(self, scene: DeviceScene, wave: RayWave) -> tuple[DeviceArray, DeviceArray]:
        """Returns the sorted grid cell keys of all surfaces, and for each entry the number of distinct keys so far."""
        count, run = wave.count, self._launcher.run_banded
        keys, order = self._get("keys", wp.int64, 2 * count), self._order(count)
        run(kernels.find_cells, count, scene.camera, wave.data, keys, order)
        sort_pairs(keys, order, count)
        is_first, ends = self._get("is_first", wp.int32, count), self._get("ends", wp.int32, count)
        run(kernels.mark_cells, count, keys, is_first)
        prefix_sum(is_first, ends, inclusive=True)
        return keys, device_array(ends)

    def _order(self, count: int) -> DeviceArray:
        """Returns the array of ray indices, sorted like the keys of the grid cells."""
        return self._get("order", wp.int32, 2 * count)

    def _get(self, name: str, dtype: type[object], count: int) -> DeviceArray:
        return self._buffers.get(f"light_grid.{name}", dtype, count)
