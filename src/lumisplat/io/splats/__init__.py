"""Reads and writes captures: Gaussian PLY, compressed PLY, SPZ, SOG, ``.splat``, ``.ksplat``, and folders of frames."""
