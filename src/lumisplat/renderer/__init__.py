"""Renders a scene and a camera to a frame. Each pass is a host module beside its kernels."""
