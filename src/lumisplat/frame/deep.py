"""Deep frames: samples in depth for each pixel, so that compositors can insert objects between them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.images.exr import write_deep_exr
from lumisplat.math.arrays import FloatArray, Rows


@dataclass(frozen=True, slots=True, eq=False)
class DeepFrame:
    """Depth samples of a frame's pixels: pixels row by row, each pixel's samples from front to back."""

    size: tuple[int, int]
    """Rows and columns of the frame, (H, W)."""
    first: Rows
    """Index of each pixel's first sample, pixels row by row, shape (H W + 1,). The last entry is the number of
    samples."""
    near: FloatArray
    """View depth at which each sample begins, scene units, one number for each sample; for fisheye cameras, the
    distance from the camera."""
    far: FloatArray
    """View depth (fisheye: distance) at which each sample ends, scene units, one number for each sample; at most
    ``near`` of the pixel's next sample."""
    color: FloatArray
    """Linear Rec.709 colour of each sample, premultiplied by that sample's alpha, shape (samples, 3)."""
    alpha: FloatArray
    """Fraction of the light from behind that each sample blocks, 0..1, one number for each sample."""

    def __repr__(self) -> str:
        return f"DeepFrame({self.size[1]} x {self.size[0]}, samples={len(self.alpha)})"

    def flattened(self) -> FloatArray:
        """Composites each pixel's samples into premultiplied linear colour and alpha, shape (H, W, 4)."""
        counts = np.diff(self.first)
        color, through = np.zeros((len(counts), 3)), np.ones(len(counts))
        for rank in range(int(counts.max(initial=0))):
            pixels = np.flatnonzero(counts > rank)
            rows = self.first[pixels] + rank
            color[pixels] += through[pixels, None] * self.color[rows]
            through[pixels] *= 1.0 - self.alpha[rows].astype(np.float64)
        flat = np.concatenate([color, 1.0 - through[:, None]], axis=1)
        return flat.reshape(*self.size, 4).astype(np.float32)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes a deep EXR: premultiplied linear ``R G B A``, and depths ``Z`` (near) and ``ZBack`` (far) of samples.

        Raises:
            FormatError: The extension is not .exr, or the file cannot be written.
        """
        if Path(path).suffix.lower() != ".exr":
            raise FormatError(path, "deep frames are written as .exr")
        channels = dict(zip("RGB", self.color.T, strict=True)) | {"A": self.alpha, "Z": self.near, "ZBack": self.far}
        write_deep_exr(path, self.size, self.first, channels)
