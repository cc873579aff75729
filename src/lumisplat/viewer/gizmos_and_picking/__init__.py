"""Gizmos, picking, and the lines drawn over a frame that show where lights are."""
