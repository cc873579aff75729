"""Primary hits (what camera rays hit): the common result of rasteriser and ray tracer, input of every integrator."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData
from lumisplat.runtime.buffers import device_array


@dataclass(frozen=True, slots=True)
class PrimaryHits:
    """Rays, padded to a multiple of the packet size, and the triangles and Gaussians that they hit."""

    rays: RayData
    meshes: MeshHits
    """Nearest triangle that each ray hits."""
    gaussians: GaussianHits
    """Gaussians in front of each ray's nearest triangle, blended or sampled."""

    @property
    def count(self) -> int:
        """Number of rays, including inactive ones."""
        return len(self.rays.t_max)

    @property
    def graph_key(self) -> object:
        """Number of rays, and addresses of the arrays of hits; a CUDA graph recorded with other values is stale.

        Rays that leave surfaces may have separate arrays for the hits on relit splat sets, although camera rays have
        none.
        """
        arrays = self.rays.is_active, self.meshes.t, self.gaussians.color, self.gaussians.relit_weight
        return self.count, [device_array(array).ptr if array else 0 for array in arrays]
