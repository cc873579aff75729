"""Derivatives of frames and rays by splats, Gaussians and the camera (docs/method/gradients.md)."""
