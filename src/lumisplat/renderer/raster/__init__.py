"""Finds primary hits by rasterisation: projects splats and triangles, lists them per tile, and composites them."""
