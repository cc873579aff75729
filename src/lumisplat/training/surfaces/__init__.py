"""What makes Gaussians lie flat on surfaces, as light needs them: terms of the loss on normals, depths and scales."""
