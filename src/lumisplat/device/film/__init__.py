"""From the samples of rays to the images of a frame."""
