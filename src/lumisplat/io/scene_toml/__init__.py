"""Reads the tables of a scene file, ``scene.toml``, with one module for each kind of table."""
