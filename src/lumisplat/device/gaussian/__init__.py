"""Gaussians along rays: response, intersection, blending and gradients."""
