"""Reads and writes glTF 2.0 files: scenes with captures, meshes, materials, lights and cameras, rigs and animations."""
