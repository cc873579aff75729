"""Lights: sampling, interactions with surfaces, direct light, and attenuation of shadow rays."""
