"""Waves of rays, which have been reflected or refracted equally often, and images of the light of the first wave."""

from __future__ import annotations

from dataclasses import dataclass, field

from lumisplat.device.structs.shading import WaveData
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import DeviceArray


@dataclass(frozen=True, slots=True)
class CarriedState:
    """What the rays of a later wave bring along."""

    weights: DeviceArray | None = None
    """Share of each in the colour of the ray that it branches off, as `WaveData` has them."""
    media: DeviceArray | None = None
    """Media that each has entered; None: none."""
    sees_environment: DeviceArray | None = None
    """Whether each sees what is infinitely far; None: all do."""


@dataclass(frozen=True, slots=True)
class RayWave:
    """Rays, what they hit, and what they see.

    Later waves overwrite its interactions and path weights, and its rays and hits unless they are the primary ones.
    """

    number: int
    """How often its rays have been reflected or refracted; 0: they come from the camera, or were given."""
    hits: PrimaryHits
    row: WaveData
    """Its arrays, for host code."""
    data: DeviceArray
    """The same for kernels, 1 element."""

    @property
    def count(self) -> int:
        """Rays, active or not."""
        return self.hits.count

    @property
    def is_primary(self) -> bool:
        """Whether its rays are the first ones."""
        return self.number == 0


@dataclass(frozen=True, slots=True)
class LightImages:
    """Light of the first wave's rays in parts, linear, one array of vec3 a part."""

    direct: list[DeviceArray] = field(default_factory=list[DeviceArray])
    """Of each light alone, unshadowed."""
    arrived: list[DeviceArray] = field(default_factory=list[DeviceArray])
    """Of each light alone, shadowed."""
    layers: dict[str, DeviceArray] = field(default_factory=dict[str, DeviceArray])
    """Further layers, by name."""
