"""Frames as units of work: one after the other in this process, or by workers, here or on a Ray cluster."""
