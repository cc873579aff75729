"""Mathematics on the host, NumPy only: checked arrays, colour, tone mapping, rotations, spherical harmonics."""
