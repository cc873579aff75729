"""Sequences of frames in which light bounces: the passes of a frame, and what is kept for the next one."""
