"""Rays through a scene from Python: what they hit, how much passes."""

from lumisplat.renderer.one_shot import focused, trace_rays, transmittance
from lumisplat.renderer.ray_profiles import RayProfile
from lumisplat.renderer.ray_queries import RayHits

__all__ = ["RayHits", "RayProfile", "focused", "trace_rays", "transmittance"]
