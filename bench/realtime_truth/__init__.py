"""Measures what frames in real time must show: how near to paths they are, and how soon they follow what changes.

Each module is a command, ``python -m bench.realtime_truth.bias`` for instance, and prints a table with the bars.
"""
