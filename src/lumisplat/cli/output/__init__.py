"""Writes the output of commands: tables, progress, images, and frames of an animation."""
