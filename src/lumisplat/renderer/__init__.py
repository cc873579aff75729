"""Renders a scene and a camera to a frame. Each rendering pass is a host module with a kernel module beside it."""
