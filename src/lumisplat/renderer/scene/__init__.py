"""The frame's plan (which passes run), and the scene on the device: assets, instances, lights, materials and BVHs."""
