"""Loads training images with camera poses, extracts them from videos, and finds their poses with COLMAP."""
