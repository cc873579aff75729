"""Scene files: what stands in a scene.toml, table by table."""
