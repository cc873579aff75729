"""Evaluates screen probes in float64, one probe or pixel at a time (docs/method/realtime.md#screen-probes)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from lumisplat.math.sh import sh_basis

Doubles = npt.NDArray[np.float64]


def square_of(direction: npt.ArrayLike) -> Doubles:
    """Maps a unit direction to a point of the unit square by angles; the map preserves area, quadrant by quadrant."""
    x, y, z = np.asarray(direction, np.float64)
    r = np.sqrt(1.0 - abs(z))  # size of the diamond with the cap's fraction of the hemisphere
    share = np.arctan2(abs(y), abs(x)) / (0.5 * np.pi)
    point = np.array([r * (1.0 - share), r * share])
    if z < 0.0:
        point = 1.0 - point[::-1]
    return 0.5 + 0.5 * np.copysign(point, [x, y])


def cell_of(direction: npt.ArrayLike, cells: int) -> int:
    """Returns the index of the cell of a unit direction."""
    x, y = np.minimum((square_of(direction) * cells).astype(int), cells - 1)
    return int(y * cells + x)


def spiral(count: int) -> Doubles:
    """Returns evenly spread unit vectors on a spiral."""
    steps = np.arange(count) + 0.5
    z = 1.0 - 2.0 * steps / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * steps
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


@dataclass(slots=True)
class Cells:
    """Cells of one probe."""

    direction: Doubles
    """Directions of the cell centres, shape (N, 3)."""
    radiance: Doubles
    nearness: Doubles
    samples: Doubles


def carried(cells: Cells, old: Doubles, new: Doubles, normal: Doubles, history: float) -> Cells:
    """Reprojects the cells of a probe from position ``old`` to ``new``, on a surface of this normal."""
    count = len(cells.samples)
    side = int(np.sqrt(count))
    moved = Cells(cells.direction, np.zeros((count, 3)), np.zeros(count), np.zeros(count))
    for cell in np.flatnonzero(cells.samples > 0.0):
        nearness, direction, target = cells.nearness[cell], cells.direction[cell], int(cell)
        if nearness * np.linalg.norm(old - new) < 1.0:
            if nearness > 0.0:
                to_hit = old + direction / nearness - new
                direction, nearness = to_hit / np.linalg.norm(to_hit), 1.0 / np.linalg.norm(to_hit)
            target = cell_of(direction, side)
        if direction @ normal < -np.sqrt(4.0 * np.pi / count):
            continue
        moved.radiance[target] += cells.samples[cell] * cells.radiance[cell]
        moved.nearness[target] += cells.samples[cell] * nearness
        moved.samples[target] += cells.samples[cell]
    filled = moved.samples > 0.0
    moved.radiance[filled] /= moved.samples[filled, None]
    moved.nearness[filled] /= moved.samples[filled]
    moved.samples = np.minimum(moved.samples, history)
    return moved


@cache
def cell_means(side: int) -> Doubles:
    """Returns the mean of each SH basis function over evenly spread directions of each cell."""
    directions = spiral(20_000)
    index = np.array([cell_of(direction, side) for direction in directions])
    basis = sh_basis(directions, 2)
    return np.array([basis[index == cell].mean(axis=0) for cell in range(side * side)])


@cache
def cosines(side: int, facing: int) -> Doubles:
    """Returns each cell's mean clamped cosine, for a surface that faces the centre of cell ``facing`` of 16 x 16."""
    directions = spiral(20_000)
    index = np.array([cell_of(direction, side) for direction in directions])
    towards = directions[[cell_of(direction, 16) == facing for direction in directions]].mean(axis=0)
    cosine = np.maximum(directions @ towards / np.linalg.norm(towards), 0.0)
    return np.array([cosine[index == cell].mean() for cell in range(side * side)])


def probe_irradiance(radiance: Doubles, normal: Doubles, probe_normal: Doubles) -> Doubles:
    """Returns the irradiance of a surface from the cells of one probe.

    SH of degree 2 are fitted to the cells' means. The residual of the cells is weighted by the cosines of a surface
    that faces about the same direction as the probe.
    """
    side = int(np.sqrt(len(radiance)))
    means = cell_means(side)
    sh = np.linalg.lstsq(means, radiance)[0]
    convolved = np.repeat([np.pi, 2.0 * np.pi / 3.0, np.pi / 4.0], [1, 3, 5])
    residual = cosines(side, cell_of(probe_normal, 16)) @ (radiance - means @ sh)
    return sh_basis(normal, 2) * convolved @ sh + 4.0 * np.pi / len(radiance) * residual


@dataclass(slots=True)
class Probe:
    """The data of a probe that a pixel reads when looking up light."""

    position: Doubles
    normal: Doubles
    distance: float
    extent: float
    value: Doubles
    """Light that the probe contributes, such as irradiance."""


def is_cut_off(point: Doubles, probe_point: Doubles, probe_distance: float, distances: Doubles) -> bool:
    """Returns True if a closer surface lies between a pixel and a probe in the image.

    A surface is closer if its distance is below 0.95 of ``probe_distance`` at 1/4, 1/2 or 3/4 of the line between them.

    Args:
        point: Centre of the pixel, (x, y).
        probe_point: Centre of the probe's pixel, (x, y).
        probe_distance: The smaller distance of both from the eye.
        distances: Distances at all pixels, shape (H, W); inf where nothing is visible.
    """
    points = [point + share * (probe_point - point) for share in (0.25, 0.5, 0.75)]
    return any(distances[int(y), int(x)] < 0.95 * probe_distance for x, y in points)


def near_mean(
    position: Doubles,
    normal: Doubles,
    distance: float,
    extent: float,
    reach: float,
    probes: list[tuple[float, Probe]],
) -> Doubles | None:
    """Returns the weighted mean of the probes around a pixel that lie on its surface, or None if there are none.

    Args:
        position: Position of the pixel's surface.
        normal: Normal of the surface.
        distance: Distance of the surface from the eye.
        extent: Extent as in ``SurfacePixels``.
        reach: Width of a tile at the surface.
        probes: Probes with their distances from the pixel in the image, in tiles.
    """
    total, weight = np.zeros(3), 0.0
    for apart, probe in probes:
        tolerance = max(extent, probe.extent)
        is_near = abs(normal @ (probe.position - position)) < max(reach, tolerance)
        if is_near and normal @ probe.normal > (0.8 if tolerance > 0.0 else 0.95):
            depth = 1.0 - abs(distance - probe.distance) / max(distance, probe.distance)
            probe_weight = (depth * (normal @ probe.normal)) ** 8 / (apart**2 + 0.05)
            total, weight = total + probe_weight * probe.value, weight + probe_weight
    return total / weight if weight > 1e-6 else None
