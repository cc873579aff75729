"""Waves (all rays after a given number of reflections and refractions), and images of the camera rays' light."""

from __future__ import annotations

from dataclasses import dataclass, field

from lumisplat.device.structs.shading import WaveData
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import DeviceArray


@dataclass(frozen=True, slots=True)
class CarriedState:
    """State that reflected and refracted rays inherit from their parent rays."""

    weights: DeviceArray | None = None
    """Weight with which each ray's radiance is added to its parent ray's; None: camera rays."""
    media: DeviceArray | None = None
    """Media (meshes of glass) that each ray is inside; None: the scene has no media."""
    sees_environment: DeviceArray | None = None
    """True for each ray that gets environment radiance if it escapes; None: all rays get it."""


@dataclass(frozen=True, slots=True)
class RayWave:
    """A wave: all rays after the same number of reflections and refractions, with their hits and radiance.

    Later waves overwrite the interactions and path weights. They also overwrite rays and hits, except those of the
    primary wave.
    """

    number: int
    """Number of reflections or refractions that the rays have behind them; 0: rays from the camera or from a caller."""
    hits: PrimaryHits
    row: WaveData
    """The wave's arrays as a struct, for host code."""
    data: DeviceArray
    """The wave's arrays as a table with one row, for kernels."""

    @property
    def count(self) -> int:
        """Number of rays, including inactive ones."""
        return self.hits.count

    @property
    def is_primary(self) -> bool:
        """True if the wave's rays come from the camera or from a caller."""
        return self.number == 0


@dataclass(frozen=True, slots=True)
class LightImages:
    """Images of the camera rays' light by light source and by layer: linear, each an array of one vec3 per ray."""

    direct: list[DeviceArray] = field(default_factory=list[DeviceArray])
    """For each light, the radiance that surfaces at the first hits reflect from this light, without shadows."""
    arrived: list[DeviceArray] = field(default_factory=list[DeviceArray])
    """For each light, the radiance that surfaces at the first hits reflect from this light, with shadows."""
    layers: dict[str, DeviceArray] = field(default_factory=dict[str, DeviceArray])
    """Images of the frame's layers (AOVs) that only the integrator knows, such as direct_diffuse or bounces, by name.
    """
