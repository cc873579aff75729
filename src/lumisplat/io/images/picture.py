"""Pictures in display colours, from any image file: the input of metrics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lumisplat.io.files.source import PathLike
from lumisplat.io.images.radiance import read_radiance
from lumisplat.io.images.texture import read_texture
from lumisplat.math.arrays import FloatArray
from lumisplat.math.color import encode_srgb

LINEAR = (".exr", ".hdr", ".pic")
"""Extensions of files that store linear light."""


def read_picture(path: PathLike) -> FloatArray:
    """As `lumisplat.io.load_image`."""
    if Path(path).suffix.lower() in LINEAR:
        return np.clip(encode_srgb(read_radiance(path)), 0.0, 1.0).astype(np.float32)
    pixels = read_texture(path).astype(np.float32) / np.float32(255.0)
    return pixels[..., :3] * pixels[..., 3:] if pixels.shape[2] == 4 else pixels
