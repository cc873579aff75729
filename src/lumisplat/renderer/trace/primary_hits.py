"""Primary hits: the interface between visibility and integrators.

The rasteriser and the ray tracer both produce these hits, and every integrator starts from them, whichever produced
them.
"""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData
from lumisplat.runtime.buffers import device_array


@dataclass(frozen=True, slots=True)
class PrimaryHits:
    """Rays, a multiple of the packet size, and their hits."""

    rays: RayData
    meshes: MeshHits
    """Nearest triangle on each ray."""
    gaussians: GaussianHits
    """Gaussians in front of that triangle, blended or sampled."""

    @property
    def count(self) -> int:
        """Number of rays, active or not."""
        return len(self.rays.t_max)

    @property
    def graph_key(self) -> object:
        """Addresses of the hits' arrays: a captured graph with other addresses is stale.

        Rays that leave surfaces may have separate arrays for relit sets where camera rays have none.
        """
        arrays = self.rays.is_active, self.meshes.t, self.gaussians.color, self.gaussians.relit_weight
        return self.count, [device_array(array).ptr if array else 0 for array in arrays]
