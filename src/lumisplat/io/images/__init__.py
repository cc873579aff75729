"""Reads and writes images: OpenEXR, Radiance HDR, 8-bit textures, animations and videos."""
