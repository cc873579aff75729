"""Computes how the rays of a wave interact with surfaces, and the direct light there."""
