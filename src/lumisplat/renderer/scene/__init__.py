"""The plan of a frame, and the scene on the device: assets, instances, lights, materials and BVHs."""
