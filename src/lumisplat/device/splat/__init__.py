"""What a pixel sees of a Gaussian: its footprint, as an ellipse of the image or along the pixel's ray, and blending."""
