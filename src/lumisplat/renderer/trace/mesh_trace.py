"""Host pass: the nearest triangle on each ray."""

from __future__ import annotations

from lumisplat.constants import TILE_BANDS_PER_THREAD
from lumisplat.device.structs.rays import RayData, RayMeshHits
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace import mesh_trace_kernels as kernels
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher


class MeshTracer:
    """Looks for the meshes that rays meet.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    def find(self, scene: DeviceScene, rays: RayData, name: str) -> RayMeshHits:
        """The nearest triangle between each ray's ``t_min`` and ``t_max``, which is moved there.

        Args:
            scene: Its meshes, after ``sync_rays``.
            rays: What to follow.
            name: Of the buffers that hold the result.
        """
        count = rays.t_max.shape[0]
        hits = self._buffers.struct(name, RayMeshHits, count)
        if scene.placements.shape[0]:
            bands = TILE_BANDS_PER_THREAD * self._launcher.threads
            self._launcher.run_banded(
                kernels.find_mesh_hits, count, scene.placements, scene.mesh_data, rays, hits, bands=bands
            )
        else:
            hits.face.fill_(-1)
        return hits
