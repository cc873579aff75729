"""Images of each light alone."""

from __future__ import annotations

from dataclasses import dataclass, field

from lumisplat.runtime.buffers import DeviceArray


@dataclass(frozen=True, slots=True)
class LightImages:
    """The light of each light alone that the rays of a sample see, linear, one array a light."""

    direct: list[DeviceArray] = field(default_factory=list[DeviceArray])
    """Unshadowed."""
    arrived: list[DeviceArray] = field(default_factory=list[DeviceArray])
    """Shadowed."""
    layers: dict[str, DeviceArray] = field(default_factory=dict[str, DeviceArray])
    """Further ones, by name."""
