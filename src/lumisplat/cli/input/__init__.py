"""Reads what users pass to commands: arguments, numbers, and the files of a scene."""
