"""Scenes as captures: what Gaussians show under lights, in their own spherical harmonics."""
