"""Rendering of frames in this process, or by workers on this machine or a Ray cluster."""
