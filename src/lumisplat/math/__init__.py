"""Mathematics of the host: arrays, colour, rotations, spherical harmonics. NumPy only."""
