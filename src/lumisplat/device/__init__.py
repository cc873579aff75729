"""Device code of the renderer: Warp structs and functions, callable from plain Python, without kernels or host code."""
