"""Primary hits: the seam between visibility and light.

The rasteriser and the ray tracer both end here, and whatever lights begins here: integrators neither know nor ask
which of them has found the hits.
"""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData


@dataclass(frozen=True, slots=True)
class PrimaryHits:
    """Rays, a multiple of a packet's, and what they hit."""

    rays: RayData
    meshes: MeshHits
    """The nearest triangles."""
    gaussians: GaussianHits
    """What the Gaussians before those give the rays."""

    @property
    def count(self) -> int:
        """Rays, active or not."""
        return len(self.rays.t_max)
