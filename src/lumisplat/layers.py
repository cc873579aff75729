"""Layers for compositing: deep frames and Cryptomattes."""

from lumisplat.frame.deep import DeepFrame
from lumisplat.frame.mattes import Matte, Mattes
from lumisplat.renderer.deep import render_deep
from lumisplat.renderer.mattes import render_mattes

__all__ = ["DeepFrame", "Matte", "Mattes", "render_deep", "render_mattes"]
