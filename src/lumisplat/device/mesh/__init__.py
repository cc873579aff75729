"""Mesh triangles: rasterisation, ray intersection, and surface attributes."""
