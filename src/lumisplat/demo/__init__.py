"""The demo scene: its meshes, textures, lights and captured daylight, all computed from formulas."""
