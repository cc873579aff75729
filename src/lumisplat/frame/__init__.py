"""A finished frame: its images, layers and views, and how they are saved."""
