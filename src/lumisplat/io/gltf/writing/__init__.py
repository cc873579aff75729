"""Scenes as glTF files."""
