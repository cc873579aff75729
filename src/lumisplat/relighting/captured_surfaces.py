"""Voxelises a capture, and measures by regression how well a light explains the brightness of its surfaces.

A light explains the brightness if surfaces that the light reaches unshadowed are brighter, in proportion to the
irradiance that they would receive.
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

# Evidence for lights in the shading of captured surfaces (docs/method/relighting.md#traces-of-light)

SURFACE_CELLS = 64
"""Voxels along each side of the cube around a capture: 8 cm in a room of 5 m."""

SURFACE_COVERAGE = 0.3
"""A voxel is solid if its Gaussians' areas times opacity sum to at least this fraction of a voxel face; haze stays
below."""

SURFACE_FLATNESS = 0.25
"""A voxel has a normal if the smallest principal variance of its Gaussians' positions is at most this fraction of the
middle one; in foliage the ratio is larger."""

SURFACE_THIN = 0.5
"""A Gaussian's shortest axis is used as its normal if its smallest scale is below this fraction of its middle scale."""

SURFACE_DISC = 1.2
"""Radius, in standard deviations, of the circle on which a Gaussian's area is sampled to voxelise it: about the root
mean square distance of the area from the centre.
"""

SURFACE_PER_CELL = 3
"""Largest number of Gaussians sampled per voxel, so that finely detailed objects do not outweigh the room."""

SURFACE_CLIP = 0.98
"""Quantile at which the luminance of sampled surfaces is clipped: light sources among them emit instead of reflecting.
"""

SURFACE_OFFSET = 1.8
"""Distance from a surface, in voxels, at which shadow rays start. It exceeds a voxel's diagonal, so that the ray
starts outside the voxel that the surface itself makes solid."""

SURFACE_STEP = 0.7
"""Distance, in voxels, between the points of a shadow ray that are tested for solid voxels."""

SURFACE_BLOCK = 4
"""Side, in voxels, of cubic blocks. Regression residuals of surfaces in one block count as correlated, because texture
is correlated."""

SURFACES_MAX = 3000
"""Maximum number of surface Gaussians in the regression; if there are more, a random subset is used."""

TRACE_RIDGE = 1e-6
"""Ridge of the luminance regression, relative to the mean square of its columns: in a closed room the columns of the
environment are 0."""

TRACE_FLOOR = 0.25
"""Lower bound, relative to the median luminance, of the modelled luminance by which residuals are divided."""

TRACE_STEPS = 4
"""Number of iterations that recompute the robust weights of the luminance regression from its residuals."""

_DISC = [(0.0, 0.0)] + [(np.cos(angle), np.sin(angle)) for angle in np.arange(8) * (np.pi / 4.0)]
"""Points on the unit disc at which a Gaussian's area is splatted into voxels: the centre, and eight on the rim."""


@dataclass(frozen=True, slots=True, eq=False)
class SolidCells:
    """A cube of n x n x n voxels, with a mask of the solid voxels, which block light."""

    solid: Flags
    """True for voxels that block light, shape (n, n, n)."""
    corner: Doubles
    """Lower corner of voxel (0, 0, 0), world space, shape (3,)."""
    cell: float
    """Side of a voxel, scene units."""

    def is_free(self, origins: Doubles, directions: Doubles, distances: npt.ArrayLike = np.inf) -> Flags:
        """Returns for each of N rays whether no voxel along it is solid, shape (N,); outside the grid all is free.

        Args:
            origins: Origins of the rays, world space, shape (N, 3).
            directions: Unit directions, shape (N, 3).
            distances: Lengths of the rays, scene units, a number or shape (N,).
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
    """M Gaussians of a capture sampled evenly over its surfaces, and the voxels that shadow them."""

    positions: Doubles
    """World-space means of the M sampled Gaussians, shape (M, 3)."""
    normals: Doubles
    """Unit normals of the M sampled surfaces, world space, of arbitrary sign, shape (M, 3)."""
    luminance: Doubles
    """Linear luminance of each surface's SH degree 0, clipped at the quantile `SURFACE_CLIP`, shape (M,)."""
    blocks: Rows
    """Number of the cubic block that contains each surface, shape (M,); a block is `SURFACE_BLOCK` voxels wide.
    Residuals within a block count as correlated."""
    cells: SolidCells
    """Voxels of the whole capture, which cast shadows on the sampled surfaces."""

    def cosines(self, directions: Doubles, distances: npt.ArrayLike = np.inf) -> Doubles:
        """Returns the cosine between each surface's normal and the light, 0 where the surface is shadowed, shape (M,).

        Surfaces are lit on either side: if one side is the inside of an object, the object itself shadows that side.

        Args:
            directions: Unit directions towards the light, shape (3,) or (M, 3).
            distances: Distances to the light, scene units, a number or shape (M,).
        """
        along = np.broadcast_to(directions, self.positions.shape)
        cosine = np.einsum("ij,ij->i", self.normals, along)
        offset = SURFACE_OFFSET * self.cells.cell
        starts = self.positions + (offset * np.sign(cosine))[:, None] * self.normals
        return np.abs(cosine) * self.cells.is_free(starts, along, np.asarray(distances) - offset)


def captured_surfaces(
    splats: tuple[SplatInstance, ...], worlds: list[Doubles], center: Doubles, extent: float
) -> CapturedSurfaces:
    """Finds the surfaces of a capture within a cube.

    Args:
        splats: Splat instances of the capture.
        worlds: World-space means of each instance.
        center: Centre of the cube, world space, shape (3,).
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
    """Grid of `SURFACE_CELLS`^3 cubic voxels: lower corner and side, without content."""

    corner: Doubles
    cell: float

    @property
    def shape(self) -> tuple[int, int, int]:
        return SURFACE_CELLS, SURFACE_CELLS, SURFACE_CELLS

    def keys(self, points: Doubles) -> tuple[Rows, Flags]:
        """Returns the flat voxel index of each point (0 if the point is outside the grid), and whether it is inside."""
        cells = np.floor((points - self.corner) / self.cell).astype(np.int64)
        inside = np.asarray(((cells >= 0) & (cells < SURFACE_CELLS)).all(axis=1))
        cells[~inside] = 0
        return (cells[:, 0] * SURFACE_CELLS + cells[:, 1]) * SURFACE_CELLS + cells[:, 2], inside


class _Discs(NamedTuple):
    """N Gaussians as flat discs in world space, with the thickness subtracted from the wide axes."""

    means: Doubles
    """World-space means of the Gaussians, shape (N, 3)."""
    first: Doubles
    """Longest axis of each Gaussian times ``sqrt(largest^2 - smallest^2)`` of its world-space scales, shape (N, 3)."""
    second: Doubles
    """Middle axis of each Gaussian times ``sqrt(middle^2 - smallest^2)`` of its world-space scales, shape (N, 3)."""
    normals: Doubles
    """Unit shortest axes of the Gaussians, of arbitrary sign, world space, shape (N, 3)."""
    area: Doubles
    """``2 pi`` times the opacity times the two larger world-space scales of each Gaussian, square scene units, shape
    (N,)."""
    luminance: Doubles
    """Linear luminance of each Gaussian's colour of SH degree 0, shape (N,)."""
    is_flat: Flags
    """True for Gaussians with a smallest scale below `SURFACE_THIN` times the middle one; the shortest axis of such a
    Gaussian is a normal."""

    @classmethod
    def joined(cls, parts: list[_Discs]) -> _Discs:
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _discs(instance: SplatInstance, world: Doubles, center: Doubles, extent: float) -> _Discs:
    """Returns the Gaussians of an instance with means ``world`` inside the cube ``center`` +- ``extent``, as discs."""
    near = np.flatnonzero(np.abs(world - center).max(axis=1) < extent)
    gaussians = instance.gaussians.subset(near)
    order = np.argsort(-gaussians.scales, axis=1, kind="stable")
    scales = instance.scale * np.take_along_axis(gaussians.scales, order, axis=1).astype(np.float64)
    axes = matrices_from_quaternions(gaussians.rotations_wxyz).transpose(0, 2, 1)
    axes = axes @ (instance.transform[:3, :3] / instance.scale).T
    rows = np.arange(near.size)
    # Isotropic Gaussians become points, because the orientation of their disc is arbitrary.
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
    """Returns per voxel: whether it is solid, its plane's normal, shape (n^3, 3), and whether its content is flat."""
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
    values, vectors = np.linalg.eigh(spread)  # reads the lower triangle
    normals, is_flat = np.zeros((count, 3)), np.zeros(count, np.bool_)
    normals[solid], is_flat[solid] = vectors[:, :, 0], values[:, 0] < SURFACE_FLATNESS * values[:, 1]
    return solid, normals, is_flat


def _evenly_spread(rows: Rows, cells: Rows) -> Rows:
    """Returns a random subset of ``rows``: at most `SURFACE_PER_CELL` per voxel (``cells``), `SURFACES_MAX` in all."""
    shuffled = np.random.default_rng(0).permutation(rows.size)
    order = shuffled[np.argsort(cells[shuffled], kind="stable")]
    starts = np.searchsorted(cells[order], cells[order])
    chosen = np.sort(order[np.arange(rows.size) - starts < SURFACE_PER_CELL])
    if chosen.size > SURFACES_MAX:
        chosen = np.sort(np.random.default_rng(0).choice(chosen, SURFACES_MAX, replace=False))
    return rows[chosen]


_EVEN_PRODUCTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Indices (i, j) of the products n_i n_j of a normal n's components that span all even functions of n up to degree 2.
"""


class Trace(NamedTuple):
    """Result of the test whether one more light shines: how well this light explains the luminance of the surfaces."""

    significance: float
    """Regression coefficient of the light's irradiance over its standard error; negative if lit surfaces are darker."""
    share: float
    """Fraction, -1..1, that the light explains of the luminance variance left by the other regression columns;
    negative if lit surfaces are darker.
    """
    factor: float
    """Regression coefficient of the light: luminance of surfaces per unit of the light's irradiance."""


@dataclass(frozen=True, slots=True, eq=False)
class Shading:
    """Robust linear regression of M surfaces' luminance on the irradiance from a smooth environment and from lights."""

    surfaces: CapturedSurfaces
    design: Doubles
    """Regression matrix, shape (M, K): even functions of the normal, irradiance from each SH of a smooth environment,
    and irradiance from each light already found."""
    weights: Doubles
    """Weight of each surface's squared residual, shape (M,): Huber's weight over the squared modelled luminance."""

    @classmethod
    def of(cls, surfaces: CapturedSurfaces, directions: Doubles, cosines: Doubles, degree: int = 1) -> Shading:
        """Starts a regression without lights; its columns are an SH environment and even functions of the normal.

        Args:
            surfaces: M surfaces.
            directions: D directions evenly spread over the sphere, shape (D, 3).
            cosines: Cosines of the surfaces towards each direction, 0 in shadow, shape (M, D), as from
                `CapturedSurfaces.cosines`.
            degree: SH degree of the environment.
        """
        normals = surfaces.normals
        even = np.stack([normals[:, i] * normals[:, j] for i, j in _EVEN_PRODUCTS], axis=1)
        environment = cosines @ sh_basis(directions, degree) * (4.0 * np.pi / len(directions))
        design = np.concatenate([even, environment], axis=1)
        return cls(surfaces, design, _robust_weights(design, surfaces.luminance))

    def with_light(self, irradiance: Doubles) -> Shading:
        """Returns the regression with one more column: a light's ``irradiance`` on the M surfaces, shape (M,)."""
        return replace(self, design=np.column_stack([self.design, irradiance]))

    def traces(self, irradiances: Doubles, counted: Flags | None = None) -> list[Trace]:
        """Returns one result for each of L candidate lights, of a regression with only this light added.

        Args:
            irradiances: Irradiance of the surfaces from each light in any unit, shape (M, L).
            counted: True for surfaces that enter the regression, shape (M,); None: all.
        """
        weights = self.weights if counted is None else self.weights * counted
        both = np.column_stack([self.surfaces.luminance, irradiances])
        left = both - _explained(self.design, both, weights)
        dark, light = left[:, 0], left[:, 1:]
        power = np.maximum(weights @ light**2, 1e-30)
        factors = (weights * dark) @ light / power
        variance = max(float(weights @ dark**2), 1e-30)
        # Residuals within a block are correlated, because texture and shadows are larger than a Gaussian.
        scores = weights[:, None] * light * (dark[:, None] - factors * light)
        sums = np.zeros((int(self.surfaces.blocks.max(initial=-1)) + 1, light.shape[1]))
        np.add.at(sums, self.surfaces.blocks, scores)
        errors = np.sqrt(np.sum(sums**2, axis=0)) / power
        shares = factors * np.abs(factors) * power / variance
        significances = np.divide(factors, errors, out=np.zeros_like(factors), where=errors > 1e-9 * np.abs(factors))
        return [Trace(*map(float, row)) for row in zip(significances, shares, factors, strict=True)]


def ground_direction(surfaces: CapturedSurfaces, center: Doubles) -> Doubles:
    """Returns -4 times the mean of unit directions over the sphere, with blocked directions counted as 0, (3,).

    A direction is blocked if its ray from ``center`` hits a solid voxel. The result points down outdoors. Its length is
    1 above an endless ground under an open sky, and 0 in a closed room or in the air.
    """
    directions = even_directions(TRACE_DIRECTIONS)
    is_open = surfaces.cells.is_free(np.broadcast_to(center, directions.shape), directions)
    # The mean over the sphere of the unit vectors in one hemisphere has length 1/4.
    return -4.0 * np.mean(is_open[:, None] * directions, axis=0)


def _robust_weights(design: Doubles, luminance: Doubles) -> Doubles:
    """Returns weights of squared residuals, shape (M,): Huber's weight over the squared modelled luminance."""
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
    """Returns the weighted least-squares fit of ``values``, shape (M,) or (M, L), by the columns of ``design``."""
    weighted = design * weights[:, None]
    gram = weighted.T @ design
    gram += TRACE_RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(design @ np.linalg.solve(gram, weighted.T @ values), np.float64)
