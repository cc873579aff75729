"""Gradients of rendered images and rays with respect to the Gaussians of a scene."""

from lumisplat.renderer.gradients.results import RayGradients, SetGradient, SplatGradients
from lumisplat.renderer.ray_gradients import ray_gradients
from lumisplat.renderer.splat_gradients import DifferentiableRenderer, splat_gradients
from lumisplat.renderer.surface_features import SurfaceFeatures

__all__ = [
    "DifferentiableRenderer",
    "RayGradients",
    "SetGradient",
    "SplatGradients",
    "SurfaceFeatures",
    "ray_gradients",
    "splat_gradients",
]
