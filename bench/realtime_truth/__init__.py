"""Measures real-time frames against path tracing: bias in still scenes, in motion, and lag after changes.

Each module is a command, ``python -m bench.realtime_truth.bias`` for instance, and prints a table with the targets.
"""
