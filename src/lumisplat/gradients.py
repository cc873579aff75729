"""Gradients of rendered images and rays with respect to the Gaussians of a scene."""

from lumisplat.renderer.gradients.arrays import RayGradients, SetGradient, SplatGradients
from lumisplat.renderer.gradients.differentiable_renderer import DifferentiableRenderer, ray_gradients, splat_gradients
from lumisplat.renderer.gradients.features import SurfaceFeatures
from lumisplat.renderer.gradients.shadow_transmittance import ShadowTransmittance, shadow_transmittance

__all__ = [
    "DifferentiableRenderer",
    "RayGradients",
    "SetGradient",
    "ShadowTransmittance",
    "SplatGradients",
    "SurfaceFeatures",
    "ray_gradients",
    "shadow_transmittance",
    "splat_gradients",
]
