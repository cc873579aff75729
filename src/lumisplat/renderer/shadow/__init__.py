"""Shadow rays: how much light passes Gaussians and meshes."""
