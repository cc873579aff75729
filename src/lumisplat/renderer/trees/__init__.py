"""Bounding volume hierarchies over boxes, Gaussians, triangles and instances, and the order in which rays walk them."""
