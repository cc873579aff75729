"""Reads the input of commands: arguments, numbers, and files of a scene."""
