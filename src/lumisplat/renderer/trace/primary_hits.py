"""Rays and what they met: where primary visibility ends, and light begins."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.device.structs.rays import GaussianHits, RayData, RayMeshHits


@dataclass(frozen=True, slots=True)
class PrimaryHits:
    """Rays, a multiple of a packet's, and what stands on them."""

    rays: RayData
    """``t_max`` is the distance of the nearest mesh; where it is not above ``t_min``, there is none."""
    hits: RayMeshHits
    """The nearest triangles."""
    radiance: GaussianHits
    """What the Gaussians before them give."""

    @property
    def count(self) -> int:
        """Rays, and places for rays."""
        return self.rays.t_max.shape[0]
