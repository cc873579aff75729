"""Fits lights and materials of a scene with known geometry to images of it."""
