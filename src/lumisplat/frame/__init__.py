"""Finished frames: images, layers and views, and how they are saved."""
