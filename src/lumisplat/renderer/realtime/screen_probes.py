"""Screen probes, which gather indirect light in real time (docs/method/realtime.md#screen-probes)."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from lumisplat.config import ProbeConfig
from lumisplat.constants import MEANS_CHUNK, PROBE_NORMALS, SHADOW_OFFSET
from lumisplat.device.gi.probe_placement import ProbeCells, ProbeData, ProbeGrid, ProbeLight, TileNeeds
from lumisplat.device.gi.surfaces import PreviousImage, SurfacePixels
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.rays import RayData
from lumisplat.math.directions import irradiance_residual, sh_fit_of_cells
from lumisplat.renderer.realtime import screen_probe_kernels as kernels
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import sort_pairs

_DEGREE = 2
"""SH degree in which probes store radiance, sufficient for irradiance (Ramamoorthi and Hanrahan 2001)."""


class ScreenProbes:
    """Probes on the surfaces that a frame shows, with the radiance that the probes have gathered over frames.

    In each frame, call ``begin``, ``place`` and ``rays``, trace the rays, and call ``update``, then ``irradiance``.
    Each array element has one writer, so the bits are the same for any number of threads.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        seed: Seed of random numbers.
        offset: Distance up to which Gaussians do not block a probe's rays, as a multiple of the scale of the Gaussian
            at the probe.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, config: ProbeConfig, seed: int = 0, offset: float = SHADOW_OFFSET
    ) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._seed, self._offset = seed, offset
        fit = sh_fit_of_cells(config.cells, _DEGREE).astype(np.float32).ravel()
        self._fit = buffers.upload("probes.fit", wp.float32, fit)
        beyond = irradiance_residual(config.cells, _DEGREE, PROBE_NORMALS).astype(np.float32).ravel()
        self._beyond = buffers.upload("probes.beyond", wp.float32, beyond)
        self._size: tuple[int, int] | None = None
        self.has_history = False
        """True if an earlier frame of the sequence has placed probes."""

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def reset(self) -> None:
        """Drops all gathered radiance: the next frame begins a new sequence."""
        self.has_history = False

    def begin(
        self, size: tuple[int, int], frame: int, size_before: tuple[int, int], image_before: PreviousImage
    ) -> None:
        """Begins a frame: writes the layout of its probes to the device.

        Args:
            size: Width and height, pixels.
            frame: Number of the frame in its sequence.
            size_before: Width and height of the previous frame's images.
            image_before: Images of the previous frame.
        """
        self._allocate(size)
        self.probes, self.cells, self.adaptive_of = self._stored(size, frame)
        self._before = self._stored(size_before, frame + 1)
        self._write_grid(size, frame, image_before)

    def place(self, surfaces: SurfacePixels, camera: wp.array[CameraData], camera_before: wp.array[CameraData]) -> None:
        """Places the probes of a frame.

        Args:
            surfaces: Surfaces of the frame's pixels.
            camera: Camera of the frame, shape (1,).
            camera_before: Camera of the previous frame, shape (1,).
        """
        self._camera = camera
        run, tiles, grids = self._launcher.run_banded, self._tiles, self._grids
        before, cells_before, adaptive_before = self._before
        inputs = grids, camera, camera_before, surfaces
        run(kernels.place_in_tiles, tiles, *inputs, before, adaptive_before, self.probes)
        keys, order = self._list("probes.needs_keys", tiles), self._tile_order
        history = before, adaptive_before
        run(kernels.find_needs, tiles, *inputs, self.probes, *history, self._needs, keys, order)
        sort_pairs(keys, order, tiles)
        run(
            kernels.place_adaptive,
            tiles,
            *(grids, camera, order, self._needs, surfaces, before, self.adaptive_of, self.probes),
        )
        run(kernels.carry_cells, self.count, grids, self.probes, before, cells_before, self.cells)
        self.has_history = True

    def outdate(self, sequence: DeviceArray) -> None:
        """Lowers the weight of all gathered radiance by that of ``sequence``; call it after ``place``."""
        self._launcher.run_banded(kernels.outdate_cells, self.count * self._cell_count, sequence, self.cells)

    def rays(self) -> RayData:
        """Returns one ray for each cell (direction) of the probes to update; rays into a probe's surface are inactive.

        Probes that were never updated come first, then those whose last update is longest ago. ``refreshed`` of the
        settings fixes the number of probes to update.
        """
        run, order = self._launcher.run_banded, self._refresh_order
        keys = self._list("probes.refresh_keys", self.count)
        run(kernels.rank_probes, self.count, self._grids, self.probes, keys, order)
        sort_pairs(keys, order, self.count)
        run(kernels.start_probe_rays, self.ray_count, self._grids, order, self.probes, self._rays)
        return self._rays

    def update(self, radiance: wp.array[wp.vec3], hit_distance: wp.array[float]) -> None:
        """Adds the radiance of the rays to their cells, and filters all cells for look-ups by pixels.

        Args:
            radiance: Linear radiance of each ray; values that are not finite are dropped.
            hit_distance: Distance of each ray's hit, scene units; inf: no hit.
        """
        run, cells = self._launcher.run_banded, self.cells
        inputs = self._refresh_order, self._rays, radiance, hit_distance, self.probes, cells
        run(kernels.add_samples, self.ray_count, self._grids, *inputs)
        weights = self._buffers.get("probes.weights", wp.float32, self.count * self._cell_count)
        inputs = self._camera, self.probes, self.adaptive_of, self._tile_order, cells
        run(kernels.filter_cells, self.count * self._cell_count, self._grids, *inputs, self.light, weights)
        tables = self._fit, self._beyond
        run(kernels.project_probes, self.count, self._grids, self.probes, *tables, weights, self.light)

    def irradiance(self, surfaces: SurfacePixels) -> DeviceArray:
        """Returns the linear irradiance on each pixel's surface from the probes, vec3; 0 where there is no surface."""
        run, get, grids = self._launcher.run_banded, self._buffers.get, self._grids
        assert self._size is not None, "call begin before irradiance"
        pixels, tiles = self._size[0] * self._size[1], self._tiles
        found, known = get("probes.found", wp.vec3, pixels), get("probes.is_known", wp.int32, pixels)
        inputs = self._camera, surfaces, self.probes, self.adaptive_of, self.light
        run(kernels.find_irradiance, pixels, grids, *inputs, found, known)
        means = mean = get("probes.tile_means", wp.vec4, tiles)
        run(kernels.tile_means, tiles, grids, found, known, means)
        while mean.shape[0] > 1:
            parts, chunks = mean, -(-mean.shape[0] // MEANS_CHUNK)
            mean = get(f"probes.means_of_{chunks}", wp.vec4, chunks)
            run(kernels.add_means, chunks, parts, mean)
        filled = get("probes.irradiance", wp.vec3, pixels)
        run(kernels.fill_pixels, pixels, grids, surfaces, found, known, means, mean, filled)
        return filled

    @property
    def grid(self) -> wp.array[ProbeGrid]:
        """Layout of the probes for ``lumisplat.device.gi.screen_probes``, a table with one row."""
        return self._grids

    @property
    def ray_count(self) -> int:
        """Number of rays that probes send per frame, one for each cell (direction) of the probes that are updated."""
        return self._refreshed * self._cell_count

    def _allocate(self, size: tuple[int, int]) -> None:
        """Allocates the arrays for an image size that hold nothing for the next frame."""
        if size == self._size:
            return
        self._size = size
        config, buffers = self._config, self._buffers
        self._columns, self._rows, self._adaptive = self._layout(size)
        self._tiles, self._cell_count = self._columns * self._rows, config.cells**2
        self._refreshed = math.ceil(config.refreshed * self._tiles)
        self.count = self._tiles + self._adaptive
        total = self.count * self._cell_count
        self._needs = buffers.struct("probes.needs", TileNeeds, self._tiles)
        self._tile_order = self._list("probes.tile_order", self._tiles)
        self._refresh_order = self._list("probes.refresh_order", self.count)
        self._rays = buffers.struct("probes.rays", RayData, self.ray_count)
        self.light = ProbeLight()
        self.light.exists = buffers.get("probes.light.exists", wp.int32, self.count)
        self.light.radiance = buffers.get("probes.light.radiance", wp.vec3, total)
        self.light.sh = buffers.get("probes.light.sh", wp.vec3, self.count * (_DEGREE + 1) ** 2)

    def _layout(self, size: tuple[int, int]) -> tuple[int, int, int]:
        """Returns the columns and rows of tiles in an image, and the largest number of adaptive probes."""
        columns, rows = (-(-side // self._config.tile) for side in size)
        return columns, rows, math.ceil(self._config.adaptive * columns * rows)

    def _stored(self, size: tuple[int, int], frame: int) -> tuple[ProbeData, ProbeCells, DeviceArray]:
        """Returns what a frame stores for the next one: probes, their cells, and the adaptive probe of each tile."""
        columns, rows, adaptive = self._layout(size)
        tiles, name = columns * rows, f"probes.{frame % 2}"
        probes = self._buffers.struct(name, ProbeData, tiles + adaptive)
        cells = self._buffers.struct(f"{name}.cells", ProbeCells, (tiles + adaptive) * self._config.cells**2)
        return probes, cells, self._buffers.get(f"{name}.adaptive_of", wp.int32, tiles)

    def _list(self, name: str, count: int) -> DeviceArray:
        """Returns an array of ``count`` integers, followed by the scratch space that sorting needs."""
        return self._buffers.get(name, wp.int32, 2 * count)

    def _write_grid(self, size: tuple[int, int], frame: int, before: PreviousImage) -> None:
        """Writes the layout of the probes for frame ``frame`` to the device."""
        grid = ProbeGrid()
        grid.width, grid.height = size
        grid.tile, grid.cells = self._config.tile, self._config.cells
        grid.tiles_x, grid.tiles_y = self._columns, self._rows
        grid.adaptive, grid.history = self._adaptive, float(self._config.history)
        grid.offset = self._offset
        grid.frame, grid.has_history = frame, int(self.has_history)
        grid.seed, grid.before = wp.uint32(self._seed), before
        self._grids = self._buffers.table("probes.grid", ProbeGrid, [grid])
