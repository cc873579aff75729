"""Reads back the image files that the package writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lumisplat.io.images.exr import read_exr
from lumisplat.io.images.texture import read_texture


def read_image(path: Path) -> dict[str, np.ndarray]:
    """Reads a PNG as ``{"srgb": (H, W, 3 or 4) uint8}``, an EXR as channels by name, an NPZ as arrays by name."""
    if path.suffix == ".png":
        return {"srgb": read_texture(path)}
    if path.suffix == ".exr":
        return read_exr(path)
    with np.load(path) as arrays:
        return dict(arrays)
