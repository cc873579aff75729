"""Data sets for computer vision: random views of a scene with depth, normals, masks and other layers."""

from lumisplat import lazy

__getattr__, __dir__, __all__ = lazy.names_of_stub(__name__, __file__)
