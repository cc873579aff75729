"""Gradients of rendered images and rays with respect to the Gaussians of a scene."""

from lumisplat.renderer.gradients.arrays import RayGradients, SetGradient, SplatGradients
from lumisplat.renderer.gradients.differentiable_renderer import DifferentiableRenderer, ray_gradients, splat_gradients
from lumisplat.renderer.gradients.features import SurfaceFeatures

__all__ = [
    "DifferentiableRenderer",
    "RayGradients",
    "SetGradient",
    "SplatGradients",
    "SurfaceFeatures",
    "ray_gradients",
    "splat_gradients",
]
