"""Paths of light: what they see, which lights they sample, where they go on, and what they bring."""
