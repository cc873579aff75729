"""Primary hits: the seam between visibility and light.

The rasteriser and the ray tracer both end here, and whatever lights begins here: integrators neither know nor ask
which of them has found the hits.
"""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData
from lumisplat.runtime.buffers import device_array


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

    @property
    def graph_key(self) -> object:
        """Which arrays the hits are in: a graph that has frozen others is stale.

        Rays that leave surfaces may tell relit sets apart where those from the camera do not.
        """
        arrays = self.rays.is_active, self.meshes.t, self.gaussians.color, self.gaussians.relit_weight
        return self.count, [device_array(array).ptr if array else 0 for array in arrays]
