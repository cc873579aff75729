"""Reads and writes camera files: COLMAP sparse models and JSON files of several programs."""
