"""Rays through a scene from Python: what they hit, how much passes."""

from lumisplat.renderer.one_shot import focused, trace_rays, transmittance
from lumisplat.renderer.rays import RayHits, RayProfile

__all__ = ["RayHits", "RayProfile", "focused", "trace_rays", "transmittance"]
