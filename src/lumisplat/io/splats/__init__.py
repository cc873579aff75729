"""Files of Gaussians: PLY, compressed PLY, SPZ, SOG, and folders of frames."""
