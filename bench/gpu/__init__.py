"""Checks a GPU, measures everything on it, and compares variants of kernels."""
