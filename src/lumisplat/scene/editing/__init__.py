"""Editing of captures: functions that return cut, cleaned, moved, joined, levelled or decimated Gaussians."""
