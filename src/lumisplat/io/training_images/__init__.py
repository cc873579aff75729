"""Training images with poses: which a folder holds, their pixels as pinholes see them, and poses from images alone."""
