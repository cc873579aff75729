"""Rays and what they hit: primary hits, their tracing through Gaussians and to meshes, waves of rays."""
