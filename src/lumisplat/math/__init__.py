"""Mathematics on the host, in NumPy only: checked arrays, colour, tone mapping, rotations, spherical harmonics."""
