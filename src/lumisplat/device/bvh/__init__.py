"""Bounding volume hierarchies: nodes, and packets of rays that traverse them."""
