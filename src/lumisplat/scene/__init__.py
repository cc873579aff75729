"""Scenes as frozen dataclasses over NumPy: cameras, Gaussians, meshes, lights, materials. No module imports Warp."""
