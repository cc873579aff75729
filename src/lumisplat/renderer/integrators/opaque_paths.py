"""Paths in scenes of opaque meshes on CPUs: blocks of camera rays are followed over all bounces, without waves."""

from __future__ import annotations

import math

import warp as wp

from lumisplat.constants import OPAQUE_BLOCK, TILE_BANDS_PER_THREAD
from lumisplat.device.path.contributions import PathImages, PathShadowRays
from lumisplat.device.path.opaque_blocks import OpaqueBlocks
from lumisplat.device.path.steps import PathData
from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData
from lumisplat.device.structs.shading import WaveData
from lumisplat.renderer.integrators import opaque_path_kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import KernelModule, Launcher

UNUSED_RAY_FIELDS = frozenset({"is_active", "t_min", "t_max", "path_length", "spread", "normal"})
"""Fields of `RayData` that the rays of blocks lack: the rays exist, and end at no distance."""

UNUSED_PATH_FIELDS = frozenset({"diffuse", "media"})
"""Fields of `PathData` that only paths with layers or glass need."""


class OpaquePaths:
    """Follows paths in scenes of opaque meshes on CPUs.

    Args:
        launcher: Runs the kernel.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernel that this class launches."""
        return [opaque_path_kernels.BY_LANES]

    def follow(self, scene: DeviceScene, plan: FramePlan, first: RayWave, images: PathImages) -> None:
        """Adds the radiance of camera rays over all bounces to images, and writes what the rays show besides light.

        Args:
            scene: The device scene, synced for rays.
            plan: Plan of the frame.
            first: The camera rays.
            images: The images, set to 0.
        """
        bands = min(TILE_BANDS_PER_THREAD * self._launcher.threads, -(-first.count // OPAQUE_BLOCK))
        count, struct, table = OPAQUE_BLOCK * bands, self._buffers.struct, self._buffers.table
        row = WaveData()
        row.rays = struct("path.block.rays", RayData, count, UNUSED_RAY_FIELDS)
        row.meshes = struct("path.block.meshes", MeshHits, count)
        depth = self._buffers.get("path.block.depth", wp.float32, count)
        depth.fill_(math.inf)
        row.gaussians = GaussianHits()
        row.gaussians.depth = depth
        row.radiance = first.row.radiance
        blocks = OpaqueBlocks()
        blocks.camera = first.data
        blocks.rows.scene = scene.shading
        blocks.rows.wave = table("path.block.wave", WaveData, [row])
        paths = struct("path.block.paths", PathData, count, UNUSED_PATH_FIELDS)
        blocks.rows.paths = table("path.block.paths", PathData, [paths])
        blocks.rows.shadows = table("path.block.shadows", PathShadowRays, [PathShadowRays()])
        blocks.rows.images = table("path.block.images", PathImages, [images])
        blocks.meshes = scene.mesh_bvh
        blocks.max_bounces, blocks.no_shadows, blocks.bands = plan.max_bounces, not plan.casts_shadows, bands
        self._launcher.run_banded(opaque_path_kernels.follow_opaque_paths, bands, blocks, bands=bands)
