"""What each light alone gives the rays of pixels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class LightImages:
    """What each light gives the rays of pixels in a sample, one array a light."""

    direct: list[Any] = field(default_factory=list)
    """Unshadowed, linear."""
    arrived: list[Any] = field(default_factory=list)
    """What of it arrives."""
