"""Traces the light that arrives at each Gaussian of a capture, on the side from which the Gaussian is visible.

Most of that light is visible in the capture itself; the rest comes from the environment or from clipped emitters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import cg

from lumisplat.constants import PACKET_RAYS, SHADOW_OFFSET
from lumisplat.math.arrays import Doubles, FloatArray, Rows
from lumisplat.math.sh import even_directions
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.relighting.albedo_fit import EnvironmentCells
from lumisplat.relighting.irradiance import Irradiance, hit_radiance
from lumisplat.renderer.rays import RayHits
from lumisplat.renderer.renderer import Renderer
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.neighbours import Pairs, cross_pairs, morton_order, pairs_of_about
from lumisplat.scene.scene import Scene

NEIGHBOURS = 12
"""Approximate number of nearby Gaussians over which traced irradiance is averaged to reduce its noise."""

NORMAL_SHARPNESS = 8
"""Weight with which irradiances of two Gaussians are averaged: the cosine between their normals to this power."""

WEIGHT_LEAST = 1e-12
"""Lower bound of sums of rays' weights by which other sums are divided."""

SMOOTHED_COLUMNS = 16
"""Number of columns of values that are averaged at once in float64, to limit memory."""


def neighbours_of(gaussians: Gaussians) -> Pairs:
    """Returns pairs of near Gaussians, in both orders and with themselves: about `NEIGHBOURS` for each Gaussian."""
    means = gaussians.means.astype(np.float64)
    return pairs_of_about(NEIGHBOURS, means, partial(cross_pairs, means, means))[0]


def normal_variances(gaussians: Gaussians, normals: Doubles, near: Pairs) -> Doubles:
    """Returns the variance of the surface's normal within the extent of each of N Gaussians, radians^2, shape (N,).

    The variance is the product of two factors: the normal's mean squared change over neighbours per squared distance,
    and the mean square of the Gaussian's two larger scales. Neighbours with opposite normals are ignored. A Gaussian
    without neighbours has variance 0.
    """
    first, second = (rows[near.first != near.second] for rows in (near.first, near.second))
    apart = np.square(gaussians.means[first].astype(np.float64) - gaussians.means[second]).sum(axis=1)
    cosines = np.clip(np.einsum("ij,ij->i", normals[first], normals[second]), 0.0, 1.0)
    turned = np.bincount(first, cosines * 2.0 * (1.0 - cosines), len(normals))
    distances = np.bincount(first, cosines * apart, len(normals))
    covered = np.sort(np.square(gaussians.scales.astype(np.float64)), axis=1)[:, 1:].mean(axis=1)
    return turned * covered / np.maximum(distances, 1e-6 * covered)


Values = TypeVar("Values", FloatArray, Doubles)


@dataclass(frozen=True, slots=True, eq=False)
class Smoother:
    """Averages per-Gaussian values over neighbours with similar normals; emitters and other Gaussians do not mix."""

    weights: Any
    """Weights of all values in the mean of each of N Gaussians: a sparse matrix of SciPy, (N, N), whose rows sum to 1.
    """

    @staticmethod
    def of(near: Pairs, normals: Doubles, emitters: Rows) -> Smoother:
        """Computes the weights of the pairs ``near`` from N normals and the Gaussians' emitter indices, -1 for none."""
        weights = np.maximum(np.einsum("ij,ij->i", normals[near.first], normals[near.second]), 0.0) ** NORMAL_SHARPNESS
        weights[(emitters[near.first] >= 0) != (emitters[near.second] >= 0)] = 0.0
        weights /= np.bincount(near.first, weights, len(normals))[near.first]
        rows = near.first.astype(np.int32), near.second.astype(np.int32)  # smaller indices, faster products
        return Smoother(csr_array((weights, rows), (len(normals), len(normals))))

    def mean(self, values: Values) -> Values:
        """Averages values of N Gaussians, C numbers each, over neighbours with similar normals, shape (N, C)."""
        smooth = np.empty_like(values)
        for first in range(0, values.shape[1], SMOOTHED_COLUMNS):
            columns = slice(first, first + SMOOTHED_COLUMNS)
            smooth[:, columns] = self.weights @ values[:, columns].astype(np.float64)
        return smooth

    def reaching(self, rows: Rows, steps: int) -> Any:
        """Returns the weights of the R Gaussians ``rows`` in means of N Gaussians, a sparse matrix of SciPy, (N, R).

        A mean is over neighbours, or over their neighbours if ``steps`` is 2.
        """
        reach = self.weights[:, rows]
        for _ in range(1, steps):
            reach = self.weights @ reach
        return reach

    def arriving(
        self, shares: Doubles, reach: Any, places: Rows, traced: Doubles, values: npt.NDArray[np.floating]
    ) -> Doubles:
        """Returns the irradiance over pi of N Gaussians from one direction, in which some traced rays, shape (N, C).

        It is the mean of ``shares`` over neighbours, times the weighted mean of ``values`` over rays nearby. Where
        there are none, it is the mean over all rays.

        Args:
            shares: Irradiance over pi that each Gaussian receives at radiance 1 if nothing blocks it, shape (N,).
            reach: Result of `reaching` for the Gaussians whose turn it is to trace rays.
            places: Columns of ``reach`` of the R Gaussians that traced rays.
            traced: Weights of the rays, shape (R,).
            values: Radiances or transmittances that the rays found, shape (R, C).
        """
        columns = np.zeros((reach.shape[1], 1 + values.shape[1]))
        columns[places, 0] = traced
        columns[places, 1:] = traced[:, None] * values
        sums = reach @ columns
        sums[sums[:, 0] <= 0.0] = columns.sum(axis=0)
        return (self.weights @ shares / np.maximum(sums[:, 0], WEIGHT_LEAST))[:, None] * sums[:, 1:]


SIDE_DIRECTIONS = 26
"""Number of directions over the sphere in which rays are traced to find from which of its two sides each Gaussian was
seen."""

SIDE_ENCLOSED = 0.1
"""A capture counts as taken from inside a room if rays escape on neither side from more than this fraction of its
Gaussians."""

OPENNESS_MIN = 0.1
"""Smallest fraction of the rays on a Gaussian's side that must leave the capture for the side to be open. Trained
walls let 2 to 6 % of the rays through. The fraction is smaller on both sides of 36 to 63 % of the Gaussians in captured
rooms, and of at most 0.2 % in captured objects."""

ESCAPED = 0.9
"""Transmittance above which a ray counts as escaped when sides are compared. Translucent Gaussians of trained captures
let a tenth to a half of each ray pass from inside an object to the outside, and that must not make the inside open."""

ESCAPED_ENOUGH = 0.2
"""Fraction of escaped rays at which a side is surely open: a larger fraction does not make the side likelier to be the
visible one.
"""

SIDE_FAR = 0.02
"""A side faces free space, and not the inside of a solid, if the mean distance to its rays' hits, relative to the
capture's extent, is above this."""

CONTENT_SCALE = 0.003
"""Difference between the mean hit distances of two sides, relative to the capture's extent, at which the vote for the
farther side is 0.5: ``vote = difference / (|difference| + CONTENT_SCALE)``."""

SIDE_STIFFNESS = 5.0
"""Weight of the term that makes neighbouring Gaussians agree on their visible sides; each Gaussian's own vote has
weight 1.
"""

SIDE_SHARPNESS = 4
"""Exponent of the cosine between two neighbours' axes in the weight with which the two agree on their visible sides."""

SIDE_STEPS = 300
"""Maximum number of conjugate gradient steps that find the visible sides."""

SIDE_ERROR = 1e-6
"""Root mean square residual at which the conjugate gradients for visible sides end; of the solution only the signs are
used.
"""

GAUSSIANS_PER_TURN = 30_000
"""Gaussians of captures larger than this take turns: of neighbours, only one traces a ray into an environment cell, and
16 of these rays share a direction. In smaller captures, neighbours are too far apart for that."""

TURNS_MAX = 8
"""Largest number of neighbouring Gaussians that take turns. Of 12 neighbours, one or two then trace into each cell."""

TURN_STEPS = 2
"""Number of averages over neighbours of what rays find in captures whose Gaussians take turns."""

SURFACE_SPREAD = 0.5
"""Standard deviation of sampled ray origins on a Gaussian, in units of the Gaussian's own standard deviations."""

COSINE_LEAST = 1e-3
"""Smallest cosine by which rays into an environment cell are weighted: a ray may lie below the horizon of a Gaussian
that faces another part of the cell."""

EMITTER_POINTS = 24
"""Number of points sampled on each emitter as the targets of shadow rays."""


class SurfacePoints:
    """Samples ray origins on Gaussians: random points, moved along the normal to the peak of the Gaussian's density.

    Args:
        gaussians: The N Gaussians of the capture.
        normals: Unit normals of the Gaussians, of either sign, shape (N, 3).
        seed: Seed of the points.
    """

    def __init__(self, gaussians: Gaussians, normals: Doubles, seed: int) -> None:
        scales = gaussians.scales.astype(np.float64)[:, None, :]
        axes = matrices_from_quaternions(gaussians.rotations_wxyz)
        slopes = np.einsum("ijk,ij->ik", axes, normals) / scales[:, 0]
        slopes /= np.linalg.norm(slopes, axis=1, keepdims=True)
        spread = SURFACE_SPREAD * scales * axes
        spread -= np.einsum("ijk,ik->ij", spread, slopes)[:, :, None] * slopes[:, None, :]
        self._means, self._spread = gaussians.means, np.ascontiguousarray(np.moveaxis(spread, 0, -1), np.float32)
        """Means, and matrices from standard normal numbers to offsets from the means, shape (3, 3, N)."""
        self._rng = np.random.default_rng([seed, 9])

    def at(self, rows: Rows) -> FloatArray:
        """Samples one point on each of the R Gaussians ``rows``, scene units, shape (R, 3)."""
        numbers = np.ascontiguousarray(self._rng.standard_normal((len(rows), 3)).T, np.float32)
        points = self._means[rows]
        for k, row in enumerate(self._spread):
            points[:, k] += sum(np.take(row[j], rows) * numbers[j] for j in range(3))
        return points


def agreed_sides(axes: Doubles, votes: Doubles, near: Pairs) -> Doubles:
    """Chooses the visible sides of N axes: signs, (N,), by strong votes, or by neighbours where votes are weak.

    The signs s minimise ``sum c_i (s_i - sign v_i)^2 + sum w_ij (s_i - sign(a_i a_j) s_j)^2 / 2`` with votes v, axes a
    and ``c_i = |v_i|``, by conjugate gradients. Votes thus spread along surfaces, however far the next strong vote is.

    Args:
        axes: Unit axes of arbitrary sign, shape (N, 3).
        votes: Votes, positive for the side along the axis; a larger magnitude counts more; shape (N,).
        near: Pairs of neighbours, in both orders.
    """
    count = len(axes)
    cosines = np.einsum("ij,ij->i", axes[near.first], axes[near.second])
    weights = SIDE_STIFFNESS * np.sign(cosines) * np.abs(cosines) ** SIDE_SHARPNESS
    weights[near.first == near.second] = 0.0
    diagonal = np.abs(votes) + np.bincount(near.first, np.abs(weights), count) + 1e-9
    matrix = diags_array(diagonal) - csr_array((weights, (near.first, near.second)), (count, count))
    tolerance, jacobi = SIDE_ERROR * np.sqrt(count), diags_array(1.0 / diagonal)
    signs, _ = cg(matrix, votes, np.sign(votes), rtol=0.0, atol=tolerance, maxiter=SIDE_STEPS, M=jacobi)
    return np.where(signs >= 0.0, 1.0, -1.0)


class IncidentRays:
    """Traces rays from the N Gaussians of a capture into the capture, to gather the light that reaches them.

    Args:
        capture: The capture.
        axes: Unit normals of arbitrary sign, shape (N, 3).
        renderer: Traces unlit rays with sorted hits.
        seed: Seed of the rays' origins and directions.
        traced: Called after each traced direction with N, for progress.
    """

    def __init__(
        self,
        capture: Gaussians,
        axes: Doubles,
        renderer: Renderer,
        seed: int,
        traced: Callable[[int], object] = lambda count: None,
    ) -> None:
        self._capture, self._axes, self._renderer, self._traced = capture, axes, renderer, traced
        self._scene = Scene([capture])
        self._points = SurfacePoints(capture, axes, seed)
        self._rng = np.random.default_rng([seed, 4])
        self._order = morton_order(capture.means)  # neighbouring rays are traced together
        self.turns = min(-(-capture.count // GAUSSIANS_PER_TURN), TURNS_MAX)
        """Number of neighbouring Gaussians of which one traces a ray into each environment cell."""
        self._members = [self._order[turn :: self.turns] for turn in range(self.turns)]
        self._reach_of: tuple[Smoother | None, list[Any]] = None, []
        self._means = capture.means.astype(np.float64)
        self._offsets = SHADOW_OFFSET * capture.scales.max(axis=1)
        self._extent = float(np.linalg.norm(np.ptp(self._means, axis=0)))

    def facing(self, near: Pairs, inside: bool | None, *, has_normals: bool) -> tuple[Doubles, bool]:
        """Returns normals towards the visible side of each Gaussian, and whether the capture was taken from inside.

        For an object, the visible side is the one from which rays escape. If rays escape from both sides, as from a
        floor, it is the side whose rays hit more of the capture, farther away. For a room, the visible side is always
        the one whose rays hit more, because nothing is behind the walls.

        Args:
            near: Pairs of neighbours, in both orders.
            inside: Whether the capture was taken from inside; None: decided by the fraction of Gaussians without open
                sides.
            has_normals: Whether the axes are normals that came with the capture; such axes are returned unchanged.
        """
        axes, rows = self._axes, self._order
        openness, escaped, distance, weights = np.zeros((4, 2, len(axes)))
        for direction in even_directions(SIDE_DIRECTIONS):
            cosines = axes[rows] @ direction
            side, cosines = (cosines < 0.0).astype(int), np.abs(cosines)  # grazing rays get small weights
            hits = self._trace(rows, np.tile(direction, (len(axes), 1)))
            openness[side, rows] += cosines * hits.transmittance
            escaped[side, rows] += cosines * (hits.transmittance > ESCAPED)
            distance[side, rows] += cosines * np.where(
                np.isfinite(hits.depth), np.minimum(hits.depth, self._extent), 0.0
            )
            weights[side, rows] += cosines
            self._traced(len(axes))
        openness, distance = openness / np.maximum(weights, 1e-6), distance / (np.maximum(weights, 1e-6) * self._extent)
        if inside is None:
            hidden = (openness < OPENNESS_MIN).all(axis=0) & (distance > SIDE_FAR).any(axis=0)
            inside = bool(hidden.mean() > SIDE_ENCLOSED)
        if has_normals:
            return axes, inside
        content = distance * (1.0 - openness)
        more = content[0] - content[1]
        votes = more / (np.abs(more) + CONTENT_SCALE)
        if not inside:
            clipped = np.minimum(escaped / np.maximum(weights, 1e-6) / ESCAPED_ENOUGH, 1.0)
            by_openness = clipped[0] - clipped[1]
            votes = by_openness + (1.0 - np.abs(by_openness)) * votes
        return agreed_sides(axes, votes, near)[:, None] * axes, inside

    def incident(
        self,
        smoother: Smoother,
        normals: Doubles,
        emitters: Rows,
        cells: EnvironmentCells,
        *,
        stores_directions: bool = False,
    ) -> Irradiance:
        """Traces rays into each environment cell; returns the irradiance on the side to which normals point.

        One of `turns` neighbouring Gaussians traces a ray into a cell. Irradiances are averaged over neighbours.

        Args:
            smoother: Averages over neighbours.
            normals: The axes, turned to the visible side, shape (N, 3).
            emitters: Index of the emitter to which each Gaussian belongs, -1 for none, shape (N,).
            cells: Environment cells over the sphere.
            stores_directions: Whether to store the irradiance from the capture by direction, too: one entry per cell.
        """
        by_direction = np.zeros((len(cells) if stores_directions else 0, len(normals), 3), np.float16)
        observed, environment = np.zeros((len(normals), 3)), np.zeros((len(cells), len(normals)), np.float32)
        reaches, groups = self._reaches(smoother), range(int(emitters.max(initial=-1)) + 1)
        hit_sums = np.zeros(len(groups))
        for cell in range(len(cells)):
            shares, places, rows, directions, traced = self._sampled_directions(normals, cells, cell)
            hits = self._trace(rows, directions)
            alpha = 1.0 - hits.transmittance.astype(np.float64)
            emitter = np.where(hits.gaussian_index >= 0, emitters[hits.gaussian_index], -1)
            radiance = (alpha * (emitter < 0))[:, None] * hit_radiance(hits, alpha)
            by_emitter = alpha[:, None] * (emitter[:, None] == np.array(groups, int))
            values = np.concatenate([radiance, hits.transmittance[:, None], by_emitter], axis=1)
            found = smoother.arriving(shares, reaches[cell % self.turns], places, traced, values)
            observed += found[:, :3]
            hit_sums += found[:, 4:].sum(axis=0)
            if stores_directions and self.turns == 1:
                by_direction[cell, rows] = traced[:, None] * radiance
            elif stores_directions:
                by_direction[cell] = found[:, :3]
            environment[cell] = found[:, 3]
            self._traced(len(normals) // self.turns)
        from_emitters = [self._from_emitter(normals, np.flatnonzero(emitters == emitter)) for emitter in groups]
        shares = smoother.mean(np.stack(from_emitters, axis=1) if from_emitters else np.zeros((len(normals), 0)))
        brought = shares.sum(axis=0)
        shares *= np.where((brought > 0.0) & (hit_sums > 0.0), hit_sums / np.maximum(brought, 1e-12), 1.0)
        directions = cells.directions if stores_directions else np.zeros((0, 3))
        return Irradiance(
            observed,
            np.ascontiguousarray(environment.T),
            shares.astype(np.float32),
            directions,
            by_direction,
        )

    def from_environment(self, smoother: Smoother, normals: Doubles, cells: EnvironmentCells) -> FloatArray:
        """Returns irradiance / pi at N Gaussians from each of K environment cells with radiance 1, with shadows.

        The arguments are as for `incident`.

        Returns:
            Float32 irradiances over pi, shape (N, K).
        """
        environment, reaches = np.zeros((len(cells), len(normals)), np.float32), self._reaches(smoother)
        for cell in range(len(cells)):
            shares, places, rows, directions, traced = self._sampled_directions(normals, cells, cell)
            passed = self._transmittance(rows, directions, np.full(len(rows), np.inf))
            reach = reaches[cell % self.turns]
            environment[cell] = smoother.arriving(shares, reach, places, traced, passed[:, None])[:, 0]
            self._traced(len(normals) // self.turns)
        return np.ascontiguousarray(environment.T)

    def clear_distance(self, row: int, direction: Doubles) -> float:
        """Returns the distance, scene units, from Gaussian number ``row`` to the next surface in a unit direction (3,).

        It is infinite if half of a ray escapes.
        """
        hits = self._trace(np.array([row]), direction[None])
        return float(hits.depth[0]) if hits.transmittance[0] < 0.5 else math.inf

    def _reaches(self, smoother: Smoother) -> list[Any]:
        """Returns `Smoother.reaching` for the Gaussians of each turn."""
        if self._reach_of[0] is not smoother:
            steps = 1 if self.turns == 1 else TURN_STEPS
            self._reach_of = smoother, [smoother.reaching(members, steps) for members in self._members]
        return self._reach_of[1]

    def _sampled_directions(
        self, normals: Doubles, cells: EnvironmentCells, cell: int
    ) -> tuple[Doubles, Rows, Rows, Doubles, Doubles]:
        """Samples directions within environment cell number ``cell`` for the Gaussians whose turn it is.

        If Gaussians take turns, neighbours whose rays form a packet share one direction, because rays then cost less
        than half.

        Returns:
            Irradiances over pi that the N Gaussians receive from the cell at radiance 1 without shadows, shape (N,);
            places, among the Gaussians whose turn it is, and indices of the R Gaussians that trace rays; the rays'
            directions, shape (R, 3); and their weights, shape (R,).
        """
        share, members = cells.solid_angles[cell] / np.pi, self._members[cell % self.turns]
        if self.turns == 1:
            directions = cells.directions_within(cell, len(normals), self._rng)
            shares = share * np.maximum(np.einsum("ij,ij->i", normals, directions), 0.0)
            places = np.flatnonzero(shares[members] > 0.0)
            rows = members[places]
            return shares, places, rows, directions[rows], shares[rows]
        quarters = cells.of(np.array([cell])).parts(2).directions
        shares = share * np.maximum(normals @ quarters.T, 0.0).mean(axis=1)
        places = np.flatnonzero(shares[members] > 0.0)
        rows = members[places]
        packets = cells.directions_within(cell, -(-len(rows) // PACKET_RAYS), self._rng)
        directions = np.repeat(packets, PACKET_RAYS, axis=0)[: len(rows)]
        cosines = np.einsum("ij,ij->i", normals[rows], directions)
        return shares, places, rows, directions, share * np.maximum(cosines, COSINE_LEAST)

    def _from_emitter(self, normals: Doubles, members: Rows) -> Doubles:
        """Returns irradiance / pi at N Gaussians from an emitter of radiance 1, up to a common factor, shape (N,).

        The emitter consists of the Gaussians ``members``. They overlap, so the sum of their areas is too large;
        `incident` corrects the result by the rays that hit the emitter.
        """
        scales = np.sort(self._capture.scales[members].astype(np.float64), axis=1)
        area = np.pi * (scales[:, 1] * scales[:, 2] * self._capture.opacities[members])
        found = np.zeros(len(normals))
        for point in self._rng.choice(members, EMITTER_POINTS, p=area / area.sum()):
            legs = self._means[point] - self._means
            distance = np.linalg.norm(legs, axis=1)
            legs /= np.maximum(distance, 1e-12)[:, None]
            at_surface, at_emitter = np.einsum("ij,ij->i", normals, legs), -(legs @ normals[point])
            near = self._offsets[point]
            rows = np.flatnonzero((at_surface > 0.0) & (at_emitter > 0.0) & (distance > near))
            arrived = self._transmittance(rows, legs[rows], distance[rows] - near)
            found[rows] += arrived * at_surface[rows] * at_emitter[rows] / distance[rows] ** 2
        return found * (area.sum() / (np.pi * EMITTER_POINTS))

    def _trace(self, rows: Rows, directions: Doubles) -> RayHits:
        """Traces one ray from each of the Gaussians ``rows``; returns the rays' hits."""
        points = self._points.at(rows)
        return self._renderer.leaving_hits(self._scene, points, directions.astype(np.float32), self._offsets[rows])

    def _transmittance(self, rows: Rows, directions: Doubles, distances: Doubles) -> FloatArray:
        """Returns the transmittance of one ray from each of the Gaussians ``rows`` up to its distance, scene units."""
        points = self._points.at(rows)
        legs, lengths = directions.astype(np.float32), distances.astype(np.float32)
        return self._renderer.leaving_transmittance(self._scene, points, legs, lengths, self._offsets[rows])
