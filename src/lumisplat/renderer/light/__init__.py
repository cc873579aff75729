"""Interactions of a wave of rays with surfaces, and their direct light."""
