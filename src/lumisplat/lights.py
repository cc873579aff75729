"""Lights and materials that change with time, and daylight."""

from lumisplat.scene.animation.daylight import Daylight
from lumisplat.scene.animation.lights import LightPath, MaterialPath, light_at

__all__ = [
    "Daylight",
    "LightPath",
    "MaterialPath",
    "light_at",
]
