"""Waves: rays after the same number of reflections and refractions, and images of the first wave's light."""

from __future__ import annotations

from dataclasses import dataclass, field

from lumisplat.device.structs.shading import WaveData
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import DeviceArray


@dataclass(frozen=True, slots=True)
class CarriedState:
    """State that the rays of a later wave inherit."""

    weights: DeviceArray | None = None
    """Weight of each ray in the colour of its parent ray, as in `WaveData`."""
    media: DeviceArray | None = None
    """Media that each ray is in; None: no media in the scene."""
    sees_environment: DeviceArray | None = None
    """True for each ray that adds environment radiance if it escapes; None: all do."""


@dataclass(frozen=True, slots=True)
class RayWave:
    """Rays, their hits, and their radiance.

    Later waves overwrite its interactions and path weights, and its rays and hits unless they are the primary ones.
    """

    number: int
    """Number of reflections or refractions so far; 0: rays from the camera or from a caller."""
    hits: PrimaryHits
    row: WaveData
    """Arrays of the wave, for host code."""
    data: DeviceArray
    """Arrays of the wave for kernels, 1 element."""

    @property
    def count(self) -> int:
        """Number of rays, active or not."""
        return self.hits.count

    @property
    def is_primary(self) -> bool:
        """True if its rays are primary rays."""
        return self.number == 0


@dataclass(frozen=True, slots=True)
class LightImages:
    """Parts of the first wave's light, linear, one vec3 array each."""

    direct: list[DeviceArray] = field(default_factory=list[DeviceArray])
    """Direct light of each light, without shadows."""
    arrived: list[DeviceArray] = field(default_factory=list[DeviceArray])
    """Direct light of each light, with shadows."""
    layers: dict[str, DeviceArray] = field(default_factory=dict[str, DeviceArray])
    """Further layers, by name."""
