"""Image resampling: bicubic interpolation, and area averages."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles, FloatArray, Rows

_Image = npt.NDArray[Any]


def cubic_samples(image: _Image, points: Doubles) -> _Image:
    """Samples an image by Catmull-Rom bicubic interpolation (1974), clamped to the range of the four nearest pixels.

    Args:
        image: Image of C channels, shape (H, W, C); the edge pixels extend outwards.
        points: Columns and rows, with pixel centres at +0.5; finite, shape (..., 2).

    Returns:
        Shape (..., C), in the precision of the image.
    """
    height, width, channels = image.shape
    corner = points.reshape(-1, 2) - 0.5
    first = np.floor(corner).astype(np.int64)
    share = (corner - first).astype(image.dtype)
    across, down = _cubic(share[:, :1]), _cubic(share[:, 1:])
    columns: list[Rows] = [np.clip(first[:, 0] + i - 1, 0, width - 1) for i in range(4)]
    rows: list[Rows] = [width * np.clip(first[:, 1] + j - 1, 0, height - 1) for j in range(4)]
    texels = image.reshape(-1, channels)
    value = np.zeros((len(first), channels), image.dtype)
    low, high = np.full_like(value, np.inf), np.full_like(value, -np.inf)
    for j, i in np.ndindex(4, 4):
        texel = texels[rows[j] + columns[i]]
        if i in (1, 2) and j in (1, 2):
            np.minimum(low, texel, out=low)
            np.maximum(high, texel, out=high)
        value += across[i] * down[j] * texel
    return np.clip(value, low, high, out=value).reshape(*points.shape[:-1], channels)


def area_mean(image: _Image, width: int, height: int) -> FloatArray:
    """Shrinks an image; each new pixel is the exact mean over its area, including fractions of pixels.

    Args:
        image: Image of C channels, shape (H, W, C).
        width: New width, 1 to W.
        height: New height, 1 to H.

    Returns:
        Shape (height, width, C).
    """
    columns = np.ascontiguousarray(_row_means(image, height).transpose(1, 0, 2))
    return np.ascontiguousarray(_row_means(columns, width).transpose(1, 0, 2))


def _row_means(image: _Image, count: int) -> FloatArray:
    """Averages the rows of an image over ``count`` strips of equal height.

    Where a strip begins or ends within a row, the row counts by its fraction inside the strip.
    """
    rows = len(image)
    if rows == count:
        return image.astype(np.float32)
    edges = np.linspace(0.0, rows, count + 1)
    whole = edges.astype(np.int64)
    above = (edges - whole).astype(np.float32)[:, None, None] * image[np.minimum(whole, rows - 1)]
    # Sum of the rows between two edges' rows, minus the part of the first row above its edge, plus the part of the next
    # edge's row above that edge.
    sums = np.add.reduceat(image, whole[:-1], axis=0, dtype=np.float32)
    return (sums - above[:-1] + above[1:]) * np.float32(count / rows)


def _cubic(share: _Image) -> list[_Image]:
    """Returns the Catmull-Rom weights (1974) of four neighbours for a point between the middle two.

    ``share`` is the fraction of the distance from the second to the third neighbour.
    """
    s, r = share, 1 - share
    return [-0.5 * s * r * r, 1 + s * s * (1.5 * s - 2.5), 1 + r * r * (1.5 * r - 2.5), -0.5 * r * s * s]
