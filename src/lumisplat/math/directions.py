"""Maps of directions: latitude-longitude images, and the equal-area octahedral map of a square (Clarberg 2008).

Axes of latitude-longitude images are those of `LightEnvironment`: +y at the top, -z in the middle, +x to the right of
the middle. In the octahedral map, equal areas are equal solid angles.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles
from lumisplat.math.sh import sh_basis


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


_POINTS = 64
"""Points along each side of a cell at which harmonics are summed."""
_COSINE_POINTS = 16
"""The same for cosines."""


def directions_of_square(points: npt.ArrayLike) -> Doubles:
    """Unit directions of points of the square, 0..1; shapes (..., 2) and (..., 3)."""
    u, v = np.moveaxis(2.0 * np.asarray(points, np.float64) - 1.0, -1, 0)
    inside = 1.0 - np.abs(u) - np.abs(v)
    r = 1.0 - np.abs(inside)
    angle = 0.25 * np.pi * ((np.abs(v) - np.abs(u)) / np.maximum(r, 1e-300) + 1.0)
    across = r * np.sqrt(2.0 - r * r)
    x = np.copysign(across * np.cos(angle), u)
    y = np.copysign(across * np.sin(angle), v)
    return np.stack([x, y, np.copysign(1.0 - r * r, inside)], axis=-1)


def cell_means(cells: int, degree: int) -> Doubles:
    """Means of the spherical harmonics over the cells of the map.

    Args:
        cells: Cells along each side.
        degree: Highest degree.

    Returns:
        Shape (cells^2, (degree + 1)^2), cells row by row.
    """
    return np.array([sh_basis(directions_of_square(points), degree).mean(axis=0) for points in _points(cells, _POINTS)])


def harmonics_of_cells(cells: int, degree: int) -> Doubles:
    """What each cell's mean adds to the coefficients of the harmonics that fit all cells' means best.

    Light of no higher degree is found exactly, so that which is the same everywhere. Integrals of the harmonics over
    the cells would find the latter only: a mean over a cell is flatter than what it is the mean of, for 8 x 8 cells by
    3 % in degree 1 and by 5 to 15 % in degree 2.

    Args:
        cells: Cells along each side.
        degree: Highest degree.

    Returns:
        Shape (cells^2, (degree + 1)^2), cells row by row.
    """
    return np.asarray(np.linalg.pinv(cell_means(cells, degree)).T, np.float64)


def irradiance_beyond(cells: int, degree: int, normals: int) -> Doubles:
    """What each cell's mean adds to an irradiance that the fit of the harmonics leaves out.

    Cosines, integrated over the cells, times what the cells' means are apart from those of the fit: light of no higher
    degree adds nothing.

    Args:
        cells: Cells along each side.
        degree: Highest degree of the harmonics.
        normals: Cells along each side of another map, whose centres are the normals of surfaces.

    Returns:
        Shape (normals^2, cells^2), both row by row.
    """
    directions = directions_of_square(_points(cells, _COSINE_POINTS))
    centers = directions_of_square(_points(normals, 1)[:, 0])
    cosines = np.array([np.maximum(directions @ center, 0.0).mean(axis=1) for center in centers])
    means = cell_means(cells, degree)
    beyond = cosines - cosines @ means @ np.linalg.pinv(means)
    return np.asarray(4.0 * np.pi / cells**2 * beyond, np.float64)


def _points(cells: int, count: int) -> Doubles:
    """Evenly spread points of each cell, as many along each side, shape (cells^2, count^2, 2)."""
    steps = (np.arange(count) + 0.5) / count
    within = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    corners = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), axis=-1).reshape(-1, 1, 2)
    return (within + corners) / cells
