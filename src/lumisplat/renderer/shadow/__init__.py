"""Traces shadow rays: their transmittance through Gaussians and meshes."""
