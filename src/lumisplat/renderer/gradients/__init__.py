"""From derivatives by pixels to derivatives by splats, Gaussians and the camera (docs/method/gradients.md)."""
