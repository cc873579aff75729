"""Computes means of square tiles of an image, and their standard errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]


class TileMeans(NamedTuple):
    """Mean colours of the tiles of an image, with their standard errors."""

    means: Doubles
    """Mean colour of each tile, shape (rows, columns, 3)."""
    errors: Doubles
    """Standard errors of the means, shape (rows, columns, 3)."""


def tile_means(image: npt.NDArray[np.floating], size: int) -> Doubles:
    """Returns means over tiles of ``size`` x ``size`` pixels, shape (rows, columns, 3)."""
    height, width, channels = image.shape
    parts = image.astype(np.float64).reshape(height // size, size, width // size, size, channels)
    means: Doubles = parts.mean(axis=(1, 3))
    return means


def tile_means_of_two(first: npt.NDArray[np.floating], second: npt.NDArray[np.floating], size: int) -> TileMeans:
    """Returns tile means of the average of two independent images; their difference estimates each pixel's variance."""
    means = tile_means(0.5 * (first.astype(np.float64) + second), size)
    spread = tile_means(0.25 * np.square(first.astype(np.float64) - second), size)
    return TileMeans(means, np.sqrt(spread) / size)
