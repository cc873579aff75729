"""Primary hits by rasterisation: splats, triangles, tiles."""
