"""Gaussians in glTF files (KHR_gaussian_splatting): their attributes, and where nodes place them."""
