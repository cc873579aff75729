"""Mesh files: OBJ, PLY, STL."""
