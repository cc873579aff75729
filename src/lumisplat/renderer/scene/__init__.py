"""The scene on the device: assets, instances, lights, materials and bounding volume hierarchies."""
