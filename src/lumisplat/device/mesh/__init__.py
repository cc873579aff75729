"""One triangle: rasterised or hit by a ray, and the surface there."""
