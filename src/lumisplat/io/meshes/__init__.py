"""Reads and writes mesh files: OBJ, PLY and STL."""
