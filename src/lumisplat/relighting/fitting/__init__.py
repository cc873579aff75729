"""Fits lights and materials of a known scene to images of it."""
