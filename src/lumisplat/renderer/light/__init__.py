"""Computes how camera, reflected and refracted rays interact with surfaces, and the direct light there."""
