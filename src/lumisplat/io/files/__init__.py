"""Helpers shared by all file formats: reading with clear errors, atomic writing, memory limits."""
