"""Lights and what they add: sampling, interactions, direct light, shadows, the lit film."""
