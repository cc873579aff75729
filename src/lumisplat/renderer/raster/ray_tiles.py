"""Lists, for each tile of the image, the Gaussians that its camera rays may hit."""

from __future__ import annotations

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import RAY_BLOCK_PX, RAY_TILE_PX
from lumisplat.device.structs.bvh import AssetBvh, Candidate, CandidateLists, Particle, SceneBvh, TraceData
from lumisplat.device.structs.raster import TileRect
from lumisplat.renderer.raster import candidate_kernels
from lumisplat.renderer.raster.binning import Binning
from lumisplat.renderer.scene.bvh_scene import common_hit_distance
from lumisplat.renderer.scene.camera_table import image_field
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace import eye_color_kernels
from lumisplat.renderer.trace.gaussian_trace import RayLists, trace_table
from lumisplat.runtime.buffers import Buffers, assign_table
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene


def asset_rows(scene: DeviceScene) -> list[AssetBvh]:
    """Returns the rows of a scene's Gaussian sets, without their BVHs."""
    rows: list[AssetBvh] = []
    for asset in scene.assets:
        row = AssetBvh()
        row.gaussians = asset.data
        rows.append(row)
    return rows or [AssetBvh()]


class RayTiles:
    """Lists, for each tile of the image, the Gaussians that its camera rays may hit.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings, which stay the same for the lifetime of the object.
        binning: Sorts Gaussians and lists them per tile.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, binning: Binning) -> None:
        self._launcher, self._buffers, self._config, self._binning = launcher, buffers, config, binning
        self._settings = buffers.get("ray_tiles.settings", TraceData, 1)
        assign_table(self._settings, trace_table(launcher, config.trace))
        self._field = buffers.get("ray_tiles.field", wp.float32, 1)
        self._hit_distance, self._slack = 0, 0.0

    def modules(self) -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [candidate_kernels, eye_color_kernels, *self._binning.modules()]

    @property
    def graph_key(self) -> object:
        """Values of the frame that recorded CUDA graphs contain: a graph is stale once any value changes."""
        return self._hit_distance, self._slack

    def begin_frame(self, scene: Scene, camera: Camera, plan: FramePlan) -> None:
        """Uploads settings that depend on the frame."""
        self._field.fill_(image_field(camera))
        self._hit_distance = common_hit_distance(scene, self._config, is_lit=plan.is_lit)
        self._slack = 0.5 if plan.jitters else 0.0

    def list(self, scene: DeviceScene) -> RayLists:
        """Returns the lists for all samples of a frame. CUDA replays a recorded graph.

        Args:
            scene: The device scene, synced.
        """
        binning = self._binning
        while True:
            key = scene.graph_key, self.graph_key, binning.growth
            lists = self._launcher.replay("ray tiles", key, lambda: self._list(scene))
            if binning.finish():
                return lists

    def _list(self, scene: DeviceScene) -> RayLists:
        self._binning.begin()
        count, get, run = scene.gaussian_count, self._buffers.get, self._launcher.run_banded
        lists, bvh = CandidateLists(), SceneBvh()
        bvh.instances, bvh.hit_distance = scene.splat_instances, self._hit_distance
        bvh.assets = self._buffers.table("ray_tiles.assets", AssetBvh, asset_rows(scene))
        lists.candidates = get("ray_tiles.candidates", Candidate, count)
        lists.particles = get("ray_tiles.particles", Particle, count)
        keys, rects = get("ray_tiles.keys", wp.uint32, count), get("ray_tiles.rects", TileRect, count)
        with self._launcher.stage("project"):
            for asset in scene.assets:
                run(
                    candidate_kernels.find_candidates,
                    asset.instanced_count,
                    *(scene.splat_camera, self._field, self._slack, scene.splat_instances),
                    *(asset.instance_ids, asset.data, lists.candidates, lists.particles, keys, rects),
                )
            if scene.has_one_eye:
                shared = [get(f"ray_tiles.eye_{name}", wp.vec3, count) for name in ("colors", "normals")]
                run(eye_color_kernels.find_eye_colors, count, scene.camera, self._settings, bvh, rects, *shared)
                bvh.eye_colors, bvh.eye_normals = shared
        with self._launcher.stage("sort"):
            order = self._binning.sort(keys)
        tiles_x, tiles_y = (-(-size // RAY_TILE_PX) for size in scene.image_size)
        with self._launcher.stage("bin"):
            tiles = self._binning.bin("raster", order, rects, tiles_x, tiles_x * tiles_y)
        lists.starts, lists.items, lists.tiles_x = tiles.starts, tiles.items, tiles_x
        lists.blocks_x, lists.blocks_y = (-(-size // RAY_BLOCK_PX) for size in scene.image_size)
        return RayLists(lists, bvh, tiles_x * tiles_y * RAY_TILE_PX * RAY_TILE_PX)
