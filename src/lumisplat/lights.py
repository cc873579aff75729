"""Lights and materials that change with time."""

from lumisplat.scene.animation.lights import LightPath, MaterialPath, light_at

__all__ = [
    "LightPath",
    "MaterialPath",
    "light_at",
]
