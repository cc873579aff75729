"""The demo scenes: their meshes, textures, lights and captured daylight, all computed from formulas."""
