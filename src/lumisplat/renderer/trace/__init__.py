"""Primary hits by rays: through Gaussians, to meshes."""
