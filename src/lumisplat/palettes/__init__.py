"""Palettes: a few vectors that stand for many, found by k-means."""
