"""Deep Gaussian shadow maps: how much of a light passes Gaussians, tabulated by direction and distance (seeds/001)."""
