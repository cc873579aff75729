"""From meshes to Gaussians: points well spread over surfaces."""
