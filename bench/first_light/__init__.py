"""Runs everything once, on a device that is new to us."""
