"""Primary hits (what camera rays hit): the common result of rasteriser and ray tracer, input of every integrator."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData


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
