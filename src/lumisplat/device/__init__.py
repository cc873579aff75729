"""The method: Warp structs and functions, callable from plain Python. No kernels, no host code."""
