"""Serves the page: access control, message validation, and ordered event handling."""
