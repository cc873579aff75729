"""Packets of rays and the boxes of bounding volume hierarchies."""
