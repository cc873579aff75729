"""Lumisplat lights 3D Gaussian scenes: captures, meshes and lights, rendered together on CPU and CUDA."""

from lumisplat import lazy

__version__ = "0.2.0"
__getattr__, __dir__, __all__ = lazy.names_of_stub(__name__, __file__)
