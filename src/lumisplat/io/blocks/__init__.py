"""Stores captures larger than memory as spatial blocks, and loads the blocks that a view shows."""
