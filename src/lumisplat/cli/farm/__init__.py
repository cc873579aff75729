"""Renders the frames of a command, in this process or by worker processes on this machine or a Ray cluster."""
