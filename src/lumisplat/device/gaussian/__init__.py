"""One Gaussian: its projection, its response along a ray, and how it is blended."""
