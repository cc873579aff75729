"""Traces rays through a scene from Python: hits and transmittance along rays, without an image."""

from lumisplat.renderer.one_shot import focused, trace_rays, transmittance
from lumisplat.renderer.rays import RayHits, RayProfile
from lumisplat.scene.ops.views import pixel_ray

__all__ = ["RayHits", "RayProfile", "focused", "pixel_ray", "trace_rays", "transmittance"]
