"""Sequences of frames in which light bounces: one host pass for each stage, with its kernels beside it."""
