"""The film: accumulates the radiance of samples and turns it into the images of a frame."""
