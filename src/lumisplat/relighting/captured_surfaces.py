"""A capture as cells, which of them are solid, and the traces that lights leave on them.

A light leaves a trace where captured surfaces are brighter the more it would shine on them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import HUBER_WIDTH, LUMINANCE, MAD_PER_DEVIATION, SH_C0, TRACE_DIRECTIONS
from lumisplat.math.arrays import Doubles, Flags, Rows
from lumisplat.math.color import decode_srgb
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.scene import SplatInstance

# Traces of light on captured surfaces (docs/method/relighting.md#traces-of-light)

SURFACE_CELLS = 64
"""Cells along each side of the cube that holds a capture: in a room of 5 m, 8 cm."""

SURFACE_COVERAGE = 0.3
"""Area of the Gaussians in a cell, times their opacity, in faces of the cell, from which it is solid: haze is not."""

SURFACE_FLATNESS = 0.25
"""Largest ratio of the smallest variance of what is in a cell to the second one: foliage has no normal."""

SURFACE_THIN = 0.5
"""Largest ratio of the smallest scale of a Gaussian to the second one for it to have a normal of its own."""

SURFACE_DISC = 1.2
"""Radius of the circle on which a Gaussian's area is put, standard deviations: about its root mean square."""

SURFACE_PER_CELL = 3
"""Gaussians of a cell that are used, at most: fine objects must not outvote the room."""

SURFACE_CLIP = 0.98
"""Quantile of the luminance of surfaces that none exceeds: lamps are not what they light."""

SURFACE_OFFSET = 1.8
"""Distance from a surface at which ways to the light start, cells: beyond the diagonal of its own."""

SURFACE_STEP = 0.7
"""Steps along ways to the light, cells."""

SURFACE_BLOCK = 4
"""Side of a block, cells: what texture makes brighter is brighter over a block, and counts once."""

SURFACES_MAX = 3000
"""Gaussians on surfaces that are used, a random choice if there are more."""

TRACE_RIDGE = 1e-6
"""Ridge of the regression, in mean squares of its columns: in a closed room the sky lights nothing."""

TRACE_FLOOR = 0.25
"""Residuals are relative to the explained luminance, at least to this share of the median."""

TRACE_STEPS = 4
"""Steps of the robust weights."""

_DISC = [(0.0, 0.0)] + [(np.cos(angle), np.sin(angle)) for angle in np.arange(8) * (np.pi / 4.0)]
"""Where a Gaussian's area is put: at its centre, and on a circle."""


@dataclass(frozen=True, slots=True, eq=False)
class SolidCells:
    """Which cells of a cube light does not pass."""

    solid: Flags
    """Shape (n, n, n)."""
    corner: Doubles
    """Lower corner of cell (0, 0, 0), world space, shape (3,)."""
    cell: float
    """Side of a cell, scene units."""

    def is_free(self, origins: Doubles, directions: Doubles, distances: npt.ArrayLike = np.inf) -> Flags:
        """Whether no solid cell is on each way, shape (N,).

        Args:
            origins: World space, shape (N, 3).
            directions: Unit, shape (N, 3).
            distances: How far the ways go, scene units, a number or shape (N,).
        """
        grid_points = (origins - self.corner) / self.cell
        step = SURFACE_STEP * directions
        left = np.broadcast_to(np.asarray(distances, np.float64), len(grid_points)) / (SURFACE_STEP * self.cell)
        size = self.solid.shape[0]
        free = np.ones(len(grid_points), np.bool_)
        alive = np.arange(len(grid_points))
        flat = self.solid.ravel()
        passed = 0
        while alive.size:
            cells = np.floor(grid_points).astype(np.int64)
            inside = ((cells >= 0) & (cells < size)).all(axis=1) & (left > passed)
            cells = np.where(inside[:, None], cells, 0)
            blocked = inside & flat[(cells[:, 0] * size + cells[:, 1]) * size + cells[:, 2]]
            free[alive[blocked]] = False
            on = inside & ~blocked
            alive, left, step = alive[on], left[on], step[on]
            grid_points = grid_points[on] + step
            passed += 1
        return free


@dataclass(frozen=True, slots=True, eq=False)
class CapturedSurfaces:
    """Gaussians of a capture that lie on surfaces, evenly spread over these."""

    positions: Doubles
    """World space, shape (M, 3)."""
    normals: Doubles
    """Unit, of either sign, shape (M, 3)."""
    luminance: Doubles
    """Linear, mean over all directions, the brightest cut, shape (M,)."""
    blocks: Rows
    """Group of neighbouring surfaces that each belongs to, 0 to the number of groups - 1, shape (M,)."""
    cells: SolidCells
    """What casts shadows on them."""

    def cosines(self, directions: Doubles, distances: npt.ArrayLike = np.inf) -> Doubles:
        """Cosine at each surface to the light from a direction, 0 where another surface is in the way, shape (M,).

        Surfaces are lit on either side: for the side that is inside of something, the thing itself is in the way.

        Args:
            directions: Towards the light, unit, shape (3,) or (M, 3).
            distances: To the light, scene units, a number or shape (M,).
        """
        along = np.broadcast_to(directions, self.positions.shape)
        cosine = np.einsum("ij,ij->i", self.normals, along)
        offset = SURFACE_OFFSET * self.cells.cell
        starts = self.positions + (offset * np.sign(cosine))[:, None] * self.normals
        return np.abs(cosine) * self.cells.is_free(starts, along, np.asarray(distances) - offset)


def captured_surfaces(
    splats: tuple[SplatInstance, ...], worlds: list[Doubles], center: Doubles, extent: float
) -> CapturedSurfaces:
    """The surfaces of a capture within a cube around a place.

    Args:
        splats: The capture.
        worlds: Means of each instance in the world.
        center: The place, world space, shape (3,).
        extent: Half the side of the cube, scene units.
    """
    discs = _Discs.joined(
        [_discs(instance, world, center, extent) for instance, world in zip(splats, worlds, strict=True)]
    )
    grid = _Grid(center - extent, 2.0 * extent / SURFACE_CELLS)
    solid, normals, is_flat = _solid_cells(discs, grid)
    cells, inside = grid.keys(discs.means)
    chosen = np.flatnonzero(inside & (discs.is_flat | is_flat[cells]) & solid[cells])
    chosen = _evenly_spread(chosen, cells[chosen])
    luminance = discs.luminance[chosen]
    blocks = np.stack(np.unravel_index(cells[chosen], grid.shape), axis=1) // SURFACE_BLOCK
    _, numbers = np.unique(blocks, axis=0, return_inverse=True)
    return CapturedSurfaces(
        positions=discs.means[chosen],
        normals=np.where(discs.is_flat[chosen, None], discs.normals[chosen], normals[cells[chosen]]),
        luminance=np.minimum(luminance, np.quantile(luminance, SURFACE_CLIP)) if chosen.size else luminance,
        blocks=numbers.ravel().astype(np.int64),
        cells=SolidCells(solid.reshape(grid.shape), grid.corner, grid.cell),
    )


@dataclass(frozen=True, slots=True)
class _Grid:
    """Cubic cells."""

    corner: Doubles
    cell: float

    @property
    def shape(self) -> tuple[int, int, int]:
        return SURFACE_CELLS, SURFACE_CELLS, SURFACE_CELLS

    def keys(self, points: Doubles) -> tuple[Rows, Flags]:
        """The cell of each point, as a number, and whether it is in the grid: 0 where it is not."""
        cells = np.floor((points - self.corner) / self.cell).astype(np.int64)
        inside = np.asarray(((cells >= 0) & (cells < SURFACE_CELLS)).all(axis=1))
        cells[~inside] = 0
        return (cells[:, 0] * SURFACE_CELLS + cells[:, 1]) * SURFACE_CELLS + cells[:, 2], inside


class _Discs(NamedTuple):
    """Gaussians as discs in the world."""

    means: Doubles
    """Shape (N, 3)."""
    first: Doubles
    """The widest axis, times the standard deviation of what is flat along it, shape (N, 3)."""
    second: Doubles
    """The next one."""
    normals: Doubles
    """Unit, of either sign, shape (N, 3)."""
    area: Doubles
    """Covered, times opacity, shape (N,)."""
    luminance: Doubles
    """Linear, shape (N,)."""
    is_flat: Flags
    """Whether it is thin enough to have a normal, shape (N,)."""

    @classmethod
    def joined(cls, parts: list[_Discs]) -> _Discs:
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _discs(instance: SplatInstance, world: Doubles, center: Doubles, extent: float) -> _Discs:
    """The Gaussians of an instance within a cube."""
    near = np.flatnonzero(np.abs(world - center).max(axis=1) < extent)
    gaussians = instance.gaussians.subset(near)
    order = np.argsort(-gaussians.scales, axis=1, kind="stable")
    scales = instance.scale * np.take_along_axis(gaussians.scales, order, axis=1).astype(np.float64)
    axes = matrices_from_quaternions(gaussians.rotations_wxyz).transpose(0, 2, 1)
    axes = axes @ (instance.transform[:3, :3] / instance.scale).T
    rows = np.arange(near.size)
    # Round Gaussians become points: a disc of theirs would lie anyhow.
    flat = np.sqrt(np.maximum(scales[:, :2] ** 2 - scales[:, 2:] ** 2, 0.0))
    display = np.maximum(SH_C0 * gaussians.sh[:, 0].astype(np.float64) + 0.5, 0.0)
    return _Discs(
        means=world[near],
        first=axes[rows, order[:, 0]] * flat[:, :1],
        second=axes[rows, order[:, 1]] * flat[:, 1:],
        normals=axes[rows, order[:, 2]],
        area=2.0 * np.pi * gaussians.opacities * scales[:, 0] * scales[:, 1],
        luminance=(decode_srgb(display) @ np.array(LUMINANCE)).astype(np.float64),
        is_flat=scales[:, 2] < SURFACE_THIN * scales[:, 1],
    )


def _solid_cells(discs: _Discs, grid: _Grid) -> tuple[Flags, Doubles, Flags]:
    """Which cells are solid, the normals of what is in them, shape (n^3, 3), and whether that is flat."""
    count = SURFACE_CELLS**3
    area, first, second = np.zeros(count), np.zeros((3, count)), np.zeros((3, 3, count))
    for u, v in _DISC:
        points = discs.means + SURFACE_DISC * (u * discs.first + v * discs.second)
        cells, inside = grid.keys(points)
        cells, weights = cells[inside], discs.area[inside] / len(_DISC)
        local = np.mod((points[inside] - grid.corner) / grid.cell, 1.0).T - 0.5
        area += np.bincount(cells, weights, count)
        for i in range(3):
            first[i] += np.bincount(cells, weights * local[i], count)
            for j in range(i + 1):
                second[i, j] += np.bincount(cells, weights * local[i] * local[j], count)
    solid = area > SURFACE_COVERAGE * grid.cell**2
    mean = first[:, solid] / area[solid]
    spread = second[:, :, solid] / area[solid] - mean[:, None] * mean[None]
    spread = np.tril(spread.transpose(2, 0, 1))
    values, vectors = np.linalg.eigh(spread)  # Reads the lower triangle.
    normals, is_flat = np.zeros((count, 3)), np.zeros(count, np.bool_)
    normals[solid], is_flat[solid] = vectors[:, :, 0], values[:, 0] < SURFACE_FLATNESS * values[:, 1]
    return solid, normals, is_flat


def _evenly_spread(rows: Rows, cells: Rows) -> Rows:
    """Few rows of each cell, and not too many in all, drawn at random."""
    shuffled = np.random.default_rng(0).permutation(rows.size)
    order = shuffled[np.argsort(cells[shuffled], kind="stable")]
    starts = np.searchsorted(cells[order], cells[order])
    chosen = np.sort(order[np.arange(rows.size) - starts < SURFACE_PER_CELL])
    if chosen.size > SURFACES_MAX:
        chosen = np.sort(np.random.default_rng(0).choice(chosen, SURFACES_MAX, replace=False))
    return rows[chosen]


_EVEN_PRODUCTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Products of the components of normals that span what depends on a normal, and not on its sign, to degree 2."""


class Trace(NamedTuple):
    """What one more light explains of the luminance of surfaces."""

    significance: float
    """Luminance for each unit of its irradiance, over the standard error of that; below 0 if darker in its light."""
    share: float
    """Of the variance that nothing else explains, -1..1; below 0 if darker in its light."""
    factor: float
    """Luminance for each unit of its irradiance."""


@dataclass(frozen=True, slots=True, eq=False)
class Shading:
    """Luminance of surfaces, and what explains it so far."""

    surfaces: CapturedSurfaces
    design: Doubles
    """Irradiance of what is known, a column each, shape (M, K)."""
    weights: Doubles
    """Of each surface's squared residual: residuals are relative, and outliers count little, shape (M,)."""

    @classmethod
    def of(cls, surfaces: CapturedSurfaces, directions: Doubles, cosines: Doubles, degree: int = 1) -> Shading:
        """Explained by nothing but surroundings that are smooth: a sky of low degree and what depends on the normal.

        Args:
            surfaces: The surfaces.
            directions: Evenly spread over the sphere, shape (D, 3).
            cosines: Of the light from each of these, shape (M, D), as from `CapturedSurfaces.cosines`.
            degree: Of the sky.
        """
        normals = surfaces.normals
        even = np.stack([normals[:, i] * normals[:, j] for i, j in _EVEN_PRODUCTS], axis=1)
        environment = cosines @ sh_basis(directions, degree) * (4.0 * np.pi / len(directions))
        design = np.concatenate([even, environment], axis=1)
        return cls(surfaces, design, _robust_weights(design, surfaces.luminance))

    def with_light(self, irradiance: Doubles) -> Shading:
        """The same with one more light known."""
        return replace(self, design=np.column_stack([self.design, irradiance]))

    def traces(self, irradiances: Doubles, counted: Flags | None = None) -> list[Trace]:
        """The trace of each of several lights alone.

        Args:
            irradiances: Of surfaces, any unit, a column each, shape (M, L).
            counted: Which surfaces count, shape (M,); None: all.
        """
        weights = self.weights if counted is None else self.weights * counted
        both = np.column_stack([self.surfaces.luminance, irradiances])
        left = both - _explained(self.design, both, weights)
        dark, light = left[:, 0], left[:, 1:]
        power = np.maximum(weights @ light**2, 1e-30)
        factors = (weights * dark) @ light / power
        variance = max(float(weights @ dark**2), 1e-30)
        # Residuals of one block go together: texture and shadows are larger than a Gaussian.
        scores = weights[:, None] * light * (dark[:, None] - factors * light)
        sums = np.zeros((int(self.surfaces.blocks.max(initial=-1)) + 1, light.shape[1]))
        np.add.at(sums, self.surfaces.blocks, scores)
        errors = np.sqrt(np.sum(sums**2, axis=0)) / power
        shares = factors * np.abs(factors) * power / variance
        significances = np.divide(factors, errors, out=np.zeros_like(factors), where=errors > 1e-9 * np.abs(factors))
        return [Trace(*map(float, row)) for row in zip(significances, shares, factors, strict=True)]


def ground_direction(surfaces: CapturedSurfaces, center: Doubles) -> Doubles:
    """Where a place is blocked more than elsewhere: the ground, outdoors; shape (3,).

    Its length is 1 over an endless ground under an open sky, and 0 in a closed room or in the air.
    """
    directions = even_directions(TRACE_DIRECTIONS)
    is_open = surfaces.cells.is_free(np.broadcast_to(center, directions.shape), directions)
    # The mean of a half space of unit vectors has length 1/4.
    return -4.0 * np.mean(is_open[:, None] * directions, axis=0)


def _robust_weights(design: Doubles, luminance: Doubles) -> Doubles:
    """Weights of squared residuals, relative to the luminance and by Huber's loss, shape (M,)."""
    weights = np.ones_like(luminance)
    if not luminance.size:
        return weights
    floor = max(TRACE_FLOOR * float(np.median(luminance)), 1e-12)
    for _ in range(TRACE_STEPS):
        explained = _explained(design, luminance, weights)
        scale = 1.0 / np.maximum(explained, floor)
        relative = np.abs(luminance - explained) * scale
        width = max(HUBER_WIDTH / MAD_PER_DEVIATION * float(np.median(relative)), 1e-6)
        weights = scale**2 * np.minimum(1.0, width / np.maximum(relative, 1e-12))
    return weights


def _explained(design: Doubles, values: Doubles, weights: Doubles) -> Doubles:
    """The part of values, shape (M,) or (M, L), that the columns of ``known`` explain: weighted least squares."""
    weighted = design * weights[:, None]
    gram = weighted.T @ design
    gram += TRACE_RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(design @ np.linalg.solve(gram, weighted.T @ values), np.float64)
