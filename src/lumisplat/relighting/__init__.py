"""Estimates the light and materials of captures, and lights avatars and objects that are placed in them."""
