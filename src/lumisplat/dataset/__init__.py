"""Data sets for vision: random views of a scene, in random light, with objects put into it."""
