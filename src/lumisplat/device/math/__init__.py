"""Colour, spherical harmonics, directions and random numbers on the device."""
