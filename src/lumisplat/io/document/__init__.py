"""Scenes that can be edited and saved as scene files."""
