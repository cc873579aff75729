"""What is known of indirect light: screen probes, and a cache of radiance in world space."""
