"""Direction maps: latitude-longitude images, and the equal-area octahedral map of a square (Clarberg 2008).

Latitude-longitude images have the axes of `LightEnvironment`: +y at the top, -z in the middle, +x to the right of the
middle. In the octahedral map, equal areas are equal solid angles.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles
from lumisplat.math.sh import sh_basis


def panorama_directions(height: int, width: int) -> Doubles:
    """Returns the unit direction of each pixel centre of a latitude-longitude image, shape (H, W, 3)."""
    theta = (np.arange(height)[:, None] + 0.5) * (np.pi / height)
    phi = (np.arange(width) + 0.5) * (2.0 * np.pi / width) - np.pi
    sine = np.sin(theta)
    return np.stack(np.broadcast_arrays(sine * np.sin(phi), np.cos(theta), -sine * np.cos(phi)), axis=-1)


def panorama_solid_angles(height: int, width: int) -> Doubles:
    """Returns the exact solid angle of one pixel in each row, steradians, shape (H,)."""
    edges = np.cos(np.arange(height + 1) * (np.pi / height))
    return (edges[:-1] - edges[1:]) * (2.0 * np.pi / width)


def panorama_lookup(image: npt.NDArray[np.floating], directions: Doubles) -> Doubles:
    """Samples a latitude-longitude image bilinearly along unit directions, as kernels do.

    The left and right edges wrap around.

    Args:
        image: Shape (H, W, 3).
        directions: Unit directions in the image's axes, shape (..., 3).

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
"""Quadrature points along each side of an octahedral cell for integrals of SH."""
_COSINE_POINTS = 16
"""Quadrature points along each side of an octahedral cell for integrals of clamped cosines."""


def directions_of_square(points: npt.ArrayLike) -> Doubles:
    """Maps points of the unit square, shape (..., 2), to unit directions, shape (..., 3), by the octahedral map."""
    u, v = np.moveaxis(2.0 * np.asarray(points, np.float64) - 1.0, -1, 0)
    inside = 1.0 - np.abs(u) - np.abs(v)
    r = 1.0 - np.abs(inside)
    angle = 0.25 * np.pi * ((np.abs(v) - np.abs(u)) / np.maximum(r, 1e-300) + 1.0)
    across = r * np.sqrt(2.0 - r * r)
    x = np.copysign(across * np.cos(angle), u)
    y = np.copysign(across * np.sin(angle), v)
    return np.stack([x, y, np.copysign(1.0 - r * r, inside)], axis=-1)


def cell_means(cells: int, degree: int) -> Doubles:
    """Returns the mean of each SH basis function over each cell of the octahedral map.

    Args:
        cells: Number of cells along each side of the map.
        degree: Highest SH degree.

    Returns:
        Means, shape (cells^2, (degree + 1)^2): one row for each cell, row by row of the map.
    """
    return np.array([sh_basis(directions_of_square(points), degree).mean(axis=0) for points in _points(cells, _POINTS)])


def sh_fit_of_cells(cells: int, degree: int) -> Doubles:
    """Returns the weights that turn the mean radiances of cells into the SH coefficients of a least-squares fit.

    The fit is exact for radiance whose SH have at most degree ``degree``. Integrating SH over the cells instead would
    be exact only for constant radiance: averaging over a cell flattens the radiance, for 8 x 8 cells by 3 % in degree
    1, and by 5 to 15 % in degree 2.

    Args:
        cells: Number of cells along each side of the octahedral map.
        degree: Highest SH degree.

    Returns:
        Weights, shape (cells^2, (degree + 1)^2): one row for each cell, row by row of the map.
    """
    return np.asarray(np.linalg.pinv(cell_means(cells, degree)).T, np.float64)


def irradiance_residual(cells: int, degree: int, normals: int) -> Doubles:
    """Returns the weights that turn the mean radiances of cells into the irradiance that their SH fit leaves out.

    A weight is the clamped cosine integrated over a cell, minus the irradiance that the SH fit of this cell gives.
    Radiance whose SH have at most degree ``degree`` contributes nothing.

    Args:
        cells: Number of cells along each side of the octahedral map of radiance.
        degree: Highest SH degree of the fit.
        normals: Number of cells along each side of a second octahedral map; the centres of its cells are the normals.

    Returns:
        Weights, shape (normals^2, cells^2): one row for each normal, one column for each cell, row by row of the maps.
    """
    directions = directions_of_square(_points(cells, _COSINE_POINTS))
    centers = directions_of_square(_points(normals, 1)[:, 0])
    cosines = np.array([np.maximum(directions @ center, 0.0).mean(axis=1) for center in centers])
    means = cell_means(cells, degree)
    beyond = cosines - cosines @ means @ np.linalg.pinv(means)
    return np.asarray(4.0 * np.pi / cells**2 * beyond, np.float64)


def _points(cells: int, count: int) -> Doubles:
    """Returns ``count`` x ``count`` points on a regular grid in each of the unit square's ``cells`` x ``cells`` cells.

    The shape is (cells^2, count^2, 2).
    """
    steps = (np.arange(count) + 0.5) / count
    within = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    corners = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), axis=-1).reshape(-1, 1, 2)
    return (within + corners) / cells
