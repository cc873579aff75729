"""Renders frames for the camera of each open page, with as much detail as the time budget of a frame allows."""
