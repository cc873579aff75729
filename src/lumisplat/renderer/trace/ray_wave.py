"""A wave of rays: those that have been reflected or refracted equally often."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lumisplat.device.structs.shading import Interactions, RayRadiance
from lumisplat.renderer.trace.primary_hits import PrimaryHits


@dataclass(frozen=True, slots=True)
class RayWave:
    """Rays, what they hit, and what they see. Later waves overwrite the hits, interactions and path weights."""

    number: int
    """How often its rays have been reflected or refracted; 0: they come from the camera, or were given."""
    hits: PrimaryHits
    interactions: Interactions
    """Where light reaches the rays; without elements in an unlit wave."""
    radiance: RayRadiance
    """What each ray sees: first without its branches, then with them."""
    path_weights: Any
    """Largest share of a ray's colour in its pixel."""
    may_branch: bool
    """Whether smooth meshes may send its rays on; otherwise the branches are undefined."""
    weights: Any
    """Share of a ray's colour in that of the ray it branches off; none in the first wave."""
    branches: Any
    """How many rays go on in each branch, 0 or 1."""
    branch_ends: Any
    """Inclusive sum of these: one more than the place of the branch's ray in the next wave."""

    @property
    def count(self) -> int:
        """Rays, active or not."""
        return self.hits.count

    @property
    def is_primary(self) -> bool:
        """Whether its rays are the first ones."""
        return self.number == 0
