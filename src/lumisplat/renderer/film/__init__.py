"""From the radiance of samples to the images of a frame."""
