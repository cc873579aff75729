"""Bakes lit scenes into captures: fits SH to the radiance that Gaussians show under lights."""
