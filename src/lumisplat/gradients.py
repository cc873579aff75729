"""Gradients of rendered images, rays, shadows and light probes by Gaussians, lights and normals."""

from lumisplat.relighting.probe_gradients import (
    CapturedProbe,
    ProbeIrradiance,
    RelitGaussians,
    captured_probe,
    probe_irradiance,
    relit_gaussians,
)
from lumisplat.renderer.gradients.arrays import RayGradients, SetGradient, SplatGradients
from lumisplat.renderer.gradients.differentiable_renderer import DifferentiableRenderer, ray_gradients, splat_gradients
from lumisplat.renderer.gradients.features import SurfaceFeatures
from lumisplat.renderer.gradients.shadow_transmittance import ShadowTransmittance, shadow_transmittance

__all__ = [
    "CapturedProbe",
    "DifferentiableRenderer",
    "ProbeIrradiance",
    "RayGradients",
    "RelitGaussians",
    "SetGradient",
    "ShadowTransmittance",
    "SplatGradients",
    "SurfaceFeatures",
    "captured_probe",
    "probe_irradiance",
    "ray_gradients",
    "relit_gaussians",
    "shadow_transmittance",
    "splat_gradients",
]
