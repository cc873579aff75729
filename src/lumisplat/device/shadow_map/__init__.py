"""Deep shadow maps of Gaussians: atlas, closed-form optical depth, culling and lookup."""
