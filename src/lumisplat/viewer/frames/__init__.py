"""Frames of each page's camera, as fine as the time allows."""
