"""Finds the hits of rays on meshes and Gaussians."""

from __future__ import annotations

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import PACKET_RAYS, TILE_BANDS_PER_THREAD
from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace import mesh_trace_kernels
from lumisplat.renderer.trace.gaussian_trace import GaussianTracer, RayLists
from lumisplat.renderer.trace.path_gaussians import DarkenedCaptures, PathGaussians
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher


class RayTracer:
    """Finds the hits of rays.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings, which stay the same for the lifetime of the object.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher = launcher
        self._meshes = MeshTracer(launcher, buffers)
        traces_paths = config.pipeline.bounces_light and config.lighting is not False
        self._gaussians = (PathGaussians if traces_paths else GaussianTracer)(launcher, buffers, config)

    def camera_modules(self, plan: FramePlan) -> list[KernelModule]:
        """Returns the kernel modules that find the hits of a frame's camera rays."""
        if plan.lists_gaussians:
            return [*self._gaussians.tile_modules(), *self._meshes.modules(has_meshes=plan.has_meshes)]
        return self.modules(plan)

    def modules(self, plan: FramePlan, *, bounced: bool = False) -> list[KernelModule]:
        """Returns the modules of the kernels that traverse BVHs; if ``bounced``, including those of secondary rays."""
        meshes = self._meshes.modules(has_meshes=plan.has_meshes)
        if isinstance(self._gaussians, PathGaussians):
            return [*self._gaussians.modules(plan, bounced=bounced), *meshes]
        return [*self._gaussians.modules(bounced=bounced), *meshes]

    def find_hits(
        self,
        scene: DeviceScene,
        rays: RayData,
        name: str,
        *,
        bounced: bool = False,
        from_eye: bool = False,
        centers: RayData | None = None,
        dark: DarkenedCaptures | None = None,
        lists: RayLists | None = None,
    ) -> PrimaryHits:
        """Returns what each ray hits: the nearest triangle, and the Gaussians in front of it.

        Args:
            scene: The device scene, synced for rays.
            rays: The rays; their number is a multiple of ``PACKET_RAYS``.
            name: Prefix of the buffers that hold the result.
            bounced: Whether the rays start at surfaces. Each ray then skips the Gaussians of its surface, as shadow
                rays do.
            from_eye: Whether all rays start at the eye of the scene's camera.
            centers: Rays through pixel centres, along which Gaussians are evaluated; None: along ``rays``.
            dark: Captures that appear black to rays of paths; None: none.
            lists: As for `GaussianTracer.find`.
        """
        with self._launcher.stage("mesh"):
            meshes = self._meshes.find(scene, rays, f"{name}.meshes", bounced=bounced)
        with self._launcher.stage("gaussians"):
            inputs = scene, centers or rays, meshes.t, f"{name}.gaussians"
            if dark is None:
                gaussians = self._gaussians.find(*inputs, bounced=bounced, from_eye=from_eye, lists=lists)
            else:
                assert isinstance(self._gaussians, PathGaussians)
                gaussians = self._gaussians.find(*inputs, bounced=bounced, dark=dark)
        return PrimaryHits(rays, meshes, gaussians)

    def find_meshes(self, scene: DeviceScene, rays: RayData, name: str) -> MeshHits:
        """Returns the nearest mesh on each ray that leaves a surface; arguments as for `find_hits`."""
        with self._launcher.stage("mesh"):
            return self._meshes.find(scene, rays, name, bounced=True)

    def find_emitted(
        self, scene: DeviceScene, rays: RayData, ends: wp.array[float], marked: DeviceArray, name: str
    ) -> GaussianHits:
        """Returns the radiance of emissive captures on secondary rays of paths; also separately for flagged captures.

        Args:
            scene: The device scene, synced for rays.
            rays: The rays; their number is a multiple of ``PACKET_RAYS``.
            ends: Distance at which each ray ends.
            marked: Copy of the scene's splat instances whose ``relit`` flag marks the captures to separate.
            name: Name of the buffers that hold the result.
        """
        assert isinstance(self._gaussians, PathGaussians)
        with self._launcher.stage("gaussians"):
            return self._gaussians.find_emitted(scene, rays, ends, marked, name)

    def find_captured(self, scene: DeviceScene, rays: RayData, ends: wp.array[float], name: str) -> GaussianHits:
        """Returns the radiance of shadow catchers alone on rays of paths that leave shadow catchers.

        Args:
            scene: The device scene, synced for rays.
            rays: The rays; their number is a multiple of ``PACKET_RAYS``.
            ends: Distance at which each ray ends; <= 0: the ray is not traced.
            name: Name of the buffers that hold the result.
        """
        assert isinstance(self._gaussians, PathGaussians)
        with self._launcher.stage("gaussians"):
            return self._gaussians.find_captured(scene, rays, ends, name)


class MeshTracer:
    """Finds the meshes that rays hit.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    @staticmethod
    def modules(*, has_meshes: bool) -> list[KernelModule]:
        """Returns the kernel modules of scenes with or without meshes."""
        return [mesh_trace_kernels] if has_meshes else []

    def find(self, scene: DeviceScene, rays: RayData, name: str, *, bounced: bool = False) -> MeshHits:
        """Returns the nearest triangle between each ray's ``t_min`` and ``t_max``.

        Args:
            scene: The device scene, synced for rays.
            rays: Rays to trace.
            name: Name of the buffers that hold the result.
            bounced: Whether the rays start at surfaces. Meshes then count from the rays' origins on, instead of from
                ``t_min`` on.
        """
        count = len(rays.t_max)
        hits = self._buffers.struct(name, MeshHits, count)
        if scene.mesh_instances.shape[0]:
            bands = TILE_BANDS_PER_THREAD * self._launcher.threads
            lanes = 1 if self._launcher.is_parallel else PACKET_RAYS
            self._launcher.run_banded(
                mesh_trace_kernels.find_mesh_hits,
                -(-count // lanes),
                *(lanes, bounced, scene.mesh_bvh, rays, hits),
                bands=bands,
            )
        else:
            device_array(hits.face).fill_(-1)
            hits.t = rays.t_max
        return hits
