"""Traces rays through a scene from Python: hits and transmittance along rays, without an image."""

from lumisplat.renderer.one_shot import focused, trace_rays, transmittance
from lumisplat.renderer.rays import RayHits, RayProfile

__all__ = ["RayHits", "RayProfile", "focused", "trace_rays", "transmittance"]
