"""Parts of pictures: windows, and blocks of samples (docs/adr/0072-parts-of-pictures.md)."""

WINDOW_STEP = 16
"""Edges of windows are multiples of so many pixels, so that what neighbouring pixels share is what it is in the whole
picture: tiles of the rasteriser (`TILE_PX`) and blocks of rays (`RAY_BLOCK_PX`)."""

PICTURE_PIXELS_MAX = 2**31 - 1
"""Pixels of a picture that frames show windows of: signed 32-bit numbers count them."""

SAMPLES_A_BLOCK = 32
"""Samples of a frame that one process adds up where several share it; frames that are shared depend on it by rounding.
A power of two, as points of Sobol sequences are well spread in such numbers."""
