"""Shadow rays: transmittance through Gaussians and meshes."""
