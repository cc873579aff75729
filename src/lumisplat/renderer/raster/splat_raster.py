"""Host pass: splats, over the mesh surfaces, into the surface buffers (Kerbl et al. 2023, section 6)."""

from __future__ import annotations

import logging
from typing import Any

import warp as wp

from lumisplat.constants import KERNEL_DEGREE, TILE_BANDS_PER_THREAD, TILE_PX
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import MeshHits, Splat, TileRect
from lumisplat.errors import SceneError
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.raster import splat_raster_kernels as kernels
from lumisplat.renderer.raster.binning import BinningChunked, BinningParallel, DepthOrder, TileLists
from lumisplat.renderer.scene.device_scene import DeviceScene, tile_grid
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera, CameraModel
from lumisplat.scene.scene import Scene

_log = logging.getLogger("lumisplat")


def refuse_lens(camera: Camera) -> None:
    """Raises a `SceneError` for a camera that only rays can draw: the raster is one sharp pinhole image at one time."""
    problem = None
    if camera.model is not CameraModel.PINHOLE:
        problem = f"is {camera.model.value}"
    elif camera.aperture > 0.0:
        problem = f"has an aperture of {camera.aperture:g}"
    elif camera.camera_from_world_end is not None:
        problem = "has a rolling shutter"
    if problem:
        name = f" '{camera.name}'" if camera.name else ""
        raise SceneError(f"camera{name} {problem}, which the raster pipeline cannot draw: use Pipeline.TRACE")


class SplatRaster:
    """Projects, orders, bins and composites splats.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        order: Sorts splats and lists them per tile.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, order: BinningChunked | BinningParallel) -> None:
        self._launcher, self._buffers, self._order = launcher, buffers, order
        self._warned_of_degrees: set[int] = set()
        self._warned_of_mirrors = False

    def warn_of_mirrors(self, scene: Scene) -> None:
        """Logs once that smooth meshes show no more than the environment, or the background, in lit frames."""
        count = sum(instance.mesh.material.is_smooth for instance in scene.meshes)
        if count and not self._warned_of_mirrors:
            self._warned_of_mirrors = True
            _log.warning(
                "%d smooth meshes (mirrors, glass) show the environment alone in the raster pipeline: "
                "Pipeline.HYBRID follows what they reflect and let through",
                count,
            )

    def warn_of_degree(self, scene: Scene) -> None:
        """Logs once for each kernel degree that is not the raster's own, which is Gaussian."""
        degrees = {instance.gaussians.kernel_degree for instance in scene.splats} - {KERNEL_DEGREE}
        for degree in sorted(degrees - self._warned_of_degrees):
            _log.warning(
                "a capture has kernel degree %d, which the raster pipeline draws as degree %d: its shapes come out "
                "right with Pipeline.TRACE",
                degree,
                KERNEL_DEGREE,
            )
        self._warned_of_degrees |= degrees

    def project(self, scene: DeviceScene) -> tuple[Any, Any, Any]:
        """Splats, depth keys and tile rectangles of all Gaussians of the scene."""
        splats = self._buffers.get("raster.splats", Splat, scene.gaussian_count)
        keys = self._buffers.get("raster.keys", wp.uint32, scene.gaussian_count)
        rects = self._buffers.get("raster.rects", TileRect, scene.gaussian_count)
        for asset in scene.assets:
            self._launcher.run_banded(
                kernels.project_splats,
                asset.placed_count,
                *(scene.camera, scene.instances, asset.instance_ids, asset.data, splats, keys, rects),
            )
        return splats, keys, rects

    def bin(self, depth_order: DepthOrder, rects: Any, camera: Camera) -> TileLists:
        """The splats of each tile, front to back."""
        tiles_x, tiles_y = tile_grid(camera)
        return self._order.bin("raster", depth_order, rects, tiles_x, tiles_x * tiles_y)

    def composite(self, scene: DeviceScene, camera: Camera, splats: Any, lists: TileLists, hits: MeshHits) -> None:
        """Blends each pixel's splats front to back down to the mesh, and the mesh or background behind them."""
        surface, nothing = (
            PixelBuffers.of(self._buffers, camera),
            self._buffers.struct("raster.no_rays", GaussianHits, 0),
        )
        self._composite(
            scene, camera, (scene.instances, splats, lists.starts, lists.items, hits, False, surface.data, nothing)
        )

    def radiate(
        self,
        scene: DeviceScene,
        camera: Camera,
        splats: Any,
        lists: TileLists,
        hits: MeshHits,
        *,
        radiance: GaussianHits,
        counts: bool,
    ) -> None:
        """The same, but writes what the splats before the mesh give the rays of the pixels.

        Tiles do not count how many are blended: where it ``counts``, pixels are worked on one by one for that.
        """
        nothing = PixelBuffers.of_shape(self._buffers, (0, 0))
        arguments = (scene.instances, splats, lists.starts, lists.items, hits, True, nothing.data)
        self._composite(scene, camera, (*arguments, radiance))
        if counts and not self._launcher.is_parallel:
            counted = self._buffers.struct("raster.counted", GaussianHits, radiance.hits.shape[0])
            self._composite(scene, camera, (*arguments, counted), by_pixel=True)
            radiance.hits = counted.hits

    def pick(
        self,
        scene: DeviceScene,
        camera: Camera,
        splats: Any,
        lists: TileLists,
        hits: MeshHits,
        *,
        lens: Any,
        radiance: GaussianHits,
    ) -> None:
        """One splat a pixel, by chance, as the radiance of its ray; lists need no order.

        ``lens`` tells the sample and the seed.
        """
        tiles_x, tiles_y = tile_grid(camera)
        inputs = (scene.camera, lens, splats, lists.starts, lists.items, hits, radiance)
        if self._launcher.is_parallel:
            self._launcher.run(kernels.pick_pixels, tiles_x * tiles_y * TILE_PX * TILE_PX, 0, *inputs)
        else:
            bands = TILE_BANDS_PER_THREAD * self._launcher.threads
            self._launcher.run_banded(kernels.pick_tiles, tiles_x * tiles_y, *inputs, bands=bands)

    def _composite(
        self, scene: DeviceScene, camera: Camera, arguments: tuple[Any, ...], *, by_pixel: bool = False
    ) -> None:
        tiles_x, tiles_y = tile_grid(camera)
        inputs = (scene.camera, *arguments)
        if self._launcher.is_parallel or by_pixel:
            self._launcher.run_banded(kernels.composite_pixels, tiles_x * tiles_y * TILE_PX * TILE_PX, *inputs)
        else:
            bands = TILE_BANDS_PER_THREAD * self._launcher.threads
            self._launcher.run_banded(kernels.composite_tiles, tiles_x * tiles_y, *inputs, bands=bands)
