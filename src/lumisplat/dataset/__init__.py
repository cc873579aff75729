"""Training data for vision: views of a scene at random positions, with layers."""

from lumisplat import lazy

__getattr__, __dir__, __all__ = lazy.names_of_stub(__name__, __file__)
