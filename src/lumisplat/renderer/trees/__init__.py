"""Bounding volume hierarchies over boxes, Gaussians, triangles and instances, and the sort order of incoherent rays."""
