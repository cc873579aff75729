"""Renders frames for the camera of each page, with as much detail as the time budget allows."""
