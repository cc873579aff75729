"""glTF 2.0: scenes, materials, lights, cameras, and rigs with their animations."""
