"""Host pass: the nearest triangle on each ray."""

from __future__ import annotations

from lumisplat.constants import TILE_BANDS_PER_THREAD
from lumisplat.device.structs.rays import MeshHits, RayData
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace import mesh_trace_kernels as kernels
from lumisplat.runtime.buffers import Buffers, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher


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
        """The kernel modules of scenes with or without meshes."""
        return [kernels] if has_meshes else []

    def find(self, scene: DeviceScene, rays: RayData, name: str, *, bounced: bool = False) -> MeshHits:
        """The nearest triangle between each ray's ``t_min`` and ``t_max``.

        Args:
            scene: Up to date for rays.
            rays: What to follow.
            name: Of the buffers that hold the result.
            bounced: Whether the rays were scattered by surfaces: meshes count from their origin on.
        """
        count = len(rays.t_max)
        hits = self._buffers.struct(name, MeshHits, count)
        if scene.mesh_instances.shape[0]:
            bands = TILE_BANDS_PER_THREAD * self._launcher.threads
            self._launcher.run_banded(
                kernels.find_mesh_hits,
                count,
                *(bounced, scene.mesh_bvh, rays, hits),
                bands=bands,
            )
        else:
            device_array(hits.face).fill_(-1)
            hits.t = rays.t_max
        return hits
