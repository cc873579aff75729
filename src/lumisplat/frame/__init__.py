"""Finished frames: their images, layers and views, and the files they are saved to."""
