"""Computations on scenes that run on the host: colours, normals, irradiance, pixel rays."""
