"""Captures cut, cleaned, moved, joined, ordered and thinned: what returns other Gaussians than it was given."""
