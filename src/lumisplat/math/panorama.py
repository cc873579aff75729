"""Latitude-longitude images: the directions and solid angles of their pixels, and bilinear lookups between pixels.

Axes are those of `LightEnvironment`: +y at the top, -z in the middle, +x to the right of the middle.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles


def panorama_directions(height: int, width: int) -> Doubles:
    """Unit directions of the pixel centres, shape (H, W, 3)."""
    theta = (np.arange(height)[:, None] + 0.5) * (np.pi / height)
    phi = (np.arange(width) + 0.5) * (2.0 * np.pi / width) - np.pi
    sine = np.sin(theta)
    return np.stack(np.broadcast_arrays(sine * np.sin(phi), np.cos(theta), -sine * np.cos(phi)), axis=-1)


def panorama_solid_angles(height: int, width: int) -> Doubles:
    """Exact solid angle of one pixel in each row, steradians, shape (H,). Times the width, they sum to 4 pi."""
    edges = np.cos(np.arange(height + 1) * (np.pi / height))
    return (edges[:-1] - edges[1:]) * (2.0 * np.pi / width)


def panorama_lookup(image: npt.NDArray[np.floating], directions: Doubles) -> Doubles:
    """Values of an image along unit directions: bilinear, with the left and right edges joined, as kernels look it up.

    Args:
        image: Shape (H, W, 3).
        directions: In the image's axes, shape (..., 3).

    Returns:
        Shape (..., 3).
    """
    height, width = image.shape[:2]
    x, y, z = np.moveaxis(directions, -1, 0)
    across = (0.5 + np.arctan2(x, -z) / (2.0 * np.pi)) * width - 0.5
    down = np.clip(np.arctan2(np.hypot(x, z), y) / np.pi * height - 0.5, 0.0, height - 1.0)
    left, top = np.floor(across).astype(int), np.floor(down).astype(int)
    right, below = across - left, down - top
    columns = (left % width, (left + 1) % width)
    rows = (top, np.minimum(top + 1, height - 1))
    upper, lower = (
        image[r, columns[0]] * (1.0 - right)[..., None] + image[r, columns[1]] * right[..., None] for r in rows
    )
    return upper * (1.0 - below)[..., None] + lower * below[..., None]
