"""A capture as cells: which are solid, how their surfaces are turned, and how bright they were captured.

The surfaces on which `estimate_lights` and `estimate_sun` measure light (docs/method/relighting.md#traces-of-light).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import (
    LUMINANCE,
    SH_C0,
    SURFACE_BLOCK,
    SURFACE_CELLS,
    SURFACE_CLIP,
    SURFACE_COVERAGE,
    SURFACE_DISC,
    SURFACE_FLATNESS,
    SURFACE_OFFSET,
    SURFACE_PER_CELL,
    SURFACE_STEP,
    SURFACE_THIN,
    SURFACES_MAX,
)
from lumisplat.math.arrays import Doubles, Flags, Rows
from lumisplat.math.color import decode_srgb
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.scene import SplatInstance

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
        places = (origins - self.corner) / self.cell
        step = SURFACE_STEP * directions
        left = np.broadcast_to(np.asarray(distances, np.float64), len(places)) / (SURFACE_STEP * self.cell)
        size = self.solid.shape[0]
        free = np.ones(len(places), np.bool_)
        alive = np.arange(len(places))
        flat = self.solid.ravel()
        passed = 0
        while alive.size:
            cells = np.floor(places).astype(np.int64)
            inside = ((cells >= 0) & (cells < size)).all(axis=1) & (left > passed)
            cells = np.where(inside[:, None], cells, 0)
            blocked = inside & flat[(cells[:, 0] * size + cells[:, 1]) * size + cells[:, 2]]
            free[alive[blocked]] = False
            on = inside & ~blocked
            alive, left, step = alive[on], left[on], step[on]
            places = places[on] + step
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
    discs = _Discs.joined([_discs(one, world, center, extent) for one, world in zip(splats, worlds, strict=True)])
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
    kept = np.sort(order[np.arange(rows.size) - starts < SURFACE_PER_CELL])
    if kept.size > SURFACES_MAX:
        kept = np.sort(np.random.default_rng(0).choice(kept, SURFACES_MAX, replace=False))
    return rows[kept]
