"""Nodes of bounding volume hierarchies, and packets of rays that traverse them."""
