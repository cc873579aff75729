"""Lights and materials of a known scene, fitted to photographs of it."""
