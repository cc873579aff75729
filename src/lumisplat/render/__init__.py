"""Stages of a frame: ``<stage>.py`` is the host pass, ``<stage>_kernels.py`` its thin kernels."""
