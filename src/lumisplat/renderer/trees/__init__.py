"""Bounding volume hierarchies over boxes, Gaussians, triangles and instances: their build and refit."""
