"""Real-time global illumination: screen probes, radiance cache, light grid, secondary rays and reprojection."""
