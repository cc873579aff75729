"""Cameras, and the pixels of their images."""
