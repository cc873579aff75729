"""Lights: sampling, interactions with surfaces, direct light, attenuation of shadow rays."""
