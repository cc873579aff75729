"""Computations on scenes on the host: colours, normals, sampling, insertion, cameras and pixel rays."""
