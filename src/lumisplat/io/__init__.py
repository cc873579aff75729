"""Reads and writes files: captures, meshes, scenes, cameras, images, blocks of large captures, training images."""

from lumisplat import lazy

__getattr__, __dir__, __all__ = lazy.names_of_stub(__name__, __file__)
