"""Device code of the renderer: Warp structs and functions, which also run as plain Python; no kernels, no host code."""
