"""Film: accumulation of ray samples in the images of a frame, and tone mapping."""
