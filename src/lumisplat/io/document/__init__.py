"""Scenes that can be edited and saved: tables of scene files, and what they were read to."""
