"""What frames in real time must show, measured: how near to paths they are, how soon they follow, what they cost.

Each module is a command, ``python -m bench.realtime_truth.bias`` for instance, and prints a table with the bars.
"""
