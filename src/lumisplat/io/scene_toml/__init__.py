"""Scene files: the tables of a `scene.toml`, one module for each kind of table."""
