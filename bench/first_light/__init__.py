"""Checks and times everything once on a new device."""
