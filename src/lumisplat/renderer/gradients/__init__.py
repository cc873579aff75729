"""Gradients of frames and rays with respect to Gaussians and the camera (docs/method/gradients.md)."""
