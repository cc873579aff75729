"""Global illumination in real time: octahedral maps, probes, caches and filters."""
