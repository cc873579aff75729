"""Means of blocks of pixels, and how certain they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]


class TileMeans(NamedTuple):
    """Blocks of an image."""

    means: Doubles
    """Shape (rows, columns, 3)."""
    errors: Doubles
    """Standard errors of the means, the same shape."""


def tile_means(image: npt.NDArray[np.floating], size: int) -> Doubles:
    """Means over blocks of ``size`` x ``size`` pixels, shape (rows, columns, 3)."""
    height, width, channels = image.shape
    parts = image.astype(np.float64).reshape(height // size, size, width // size, size, channels)
    means: Doubles = parts.mean(axis=(1, 3))
    return means


def tile_means_of_two(first: npt.NDArray[np.floating], second: npt.NDArray[np.floating], size: int) -> TileMeans:
    """Of the mean of two images that are independent: a pixel's variance is seen in how they differ there."""
    means = tile_means(0.5 * (first.astype(np.float64) + second), size)
    spread = tile_means(0.25 * np.square(first.astype(np.float64) - second), size)
    return TileMeans(means, np.sqrt(spread) / size)
