"""From meshes to Gaussians: blue-noise points on surfaces, and the discs around them."""
