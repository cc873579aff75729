"""glTF 2.0 files: scenes with meshes, materials, lights and cameras, and rigs with animations."""
