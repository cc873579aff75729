"""Image files: textures and pictures, PNG, EXR, NPZ and Radiance HDR, animations and videos."""
