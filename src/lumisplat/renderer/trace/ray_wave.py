"""A wave of rays: those that have been reflected or refracted equally often."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lumisplat.renderer.trace.primary_hits import PrimaryHits


@dataclass(frozen=True, slots=True)
class RayWave:
    """Rays that have been reflected or refracted equally often. Later waves overwrite the first two fields."""

    met: PrimaryHits
    path_weights: Any
    """Largest share of a ray's colour in its pixel."""
    weights: Any
    """Share of a ray's colour in that of the ray it branches off; none in the first wave."""
    colors: Any
    """What each ray sees, first without its branches, then with them: display-referred sRGB, or RayColors if lit."""
    branches: Any
    """How many rays go on in each branch, 0 or 1."""
    branch_ends: Any
    """Inclusive sum of these: one more than where the branch's ray is in the next wave."""

    @property
    def count(self) -> int:
        """Rays, and places for rays."""
        return self.met.count
