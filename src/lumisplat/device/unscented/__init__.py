"""Gaussians as the rays of pixels meet them, and the pixels that may see them."""
