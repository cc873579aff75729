"""Captures larger than memory: blocks of space on disk, loaded by what a view sees (docs/adr/0073)."""
