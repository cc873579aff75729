"""Mesh files: OBJ, PLY and STL."""
