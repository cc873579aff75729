"""Rays and their hits: primary hits, tracing through Gaussians and to meshes, and waves of rays."""
