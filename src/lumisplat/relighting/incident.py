"""Finds the light that arrives at each Gaussian of a capture, at points where it is visible.

Most of that light is shown by the capture itself; the rest is environment or a clipped light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import cg

from lumisplat.constants import SHADOW_OFFSET
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
"""Gaussians, about, over which the light at a Gaussian is averaged: it changes less than its noise."""

NORMAL_SHARPNESS = 8
"""Exponent of the cosine between normals of those."""


def neighbours_of(gaussians: Gaussians) -> Pairs:
    """Pairs of Gaussians near each other, in both orders and with themselves, about `NEIGHBOURS` of each."""
    means = gaussians.means.astype(np.float64)
    return pairs_of_about(NEIGHBOURS, means, partial(cross_pairs, means, means))[0]


def normal_variances(gaussians: Gaussians, normals: Doubles, near: Pairs) -> Doubles:
    """By how much a surface turns within each Gaussian: variance of its normal along an axis, radians^2, shape (N,).

    Normals of neighbours on the same side turn by so much a distance, in the mean of squares; a Gaussian covers its
    two larger scales. Where nothing is near, it is 0.
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
    """Means over neighbours that face the same way, lamps apart: light changes less among them than its noise."""

    near: Pairs
    weights: Doubles
    """Of each pair; they add up to 1 for the first one."""

    @staticmethod
    def of(near: Pairs, normals: Doubles, emitters: Rows) -> Smoother:
        """Of Gaussians with these normals, some of which are of lamps (-1: none)."""
        weights = np.maximum(np.einsum("ij,ij->i", normals[near.first], normals[near.second]), 0.0) ** NORMAL_SHARPNESS
        weights[(emitters[near.first] >= 0) != (emitters[near.second] >= 0)] = 0.0
        return Smoother(near, weights / np.bincount(near.first, weights, len(normals))[near.first])

    def mean(self, values: Values) -> Values:
        """Of each column, shape (N, C)."""
        smooth = np.empty_like(values)
        for column in range(values.shape[1]):
            weighted = self.weights * values[self.near.second, column]
            smooth[:, column] = np.bincount(self.near.first, weighted, len(values))
        return smooth

    def incident(self, incident: Irradiance) -> Irradiance:
        """Smooth light; what comes from each direction stays as it is."""
        smooth = {name: self.mean(getattr(incident, name)) for name in ("observed", "environment", "emitters")}
        return replace(incident, **smooth)


SIDE_DIRECTIONS = 26
"""Directions over the sphere in which Gaussians look for the side from which they are seen."""

SIDE_ENCLOSED = 0.1
"""Share of Gaussians that see no sky on either side, from which on a capture was taken from inside of it."""

OPENNESS_MIN = 0.1
"""Share of the sky that a side sees at least, if it sees any: walls that were learnt from photographs let 2 to 6 %
through. Of captured rooms, 36 to 63 % of the Gaussians see less on both sides, of captured objects at most 0.2 %."""

OPENNESS_ENOUGH = 0.2
"""Share of the sky from which on more of it does not make a side likelier to be the one that was seen."""

SIDE_FAR = 0.02
"""Mean distance of what a side sees, in extents of the set, from which on it is open."""

CONTENT_SCALE = 0.003
"""Difference between what two sides see of the set, as a mean distance in its extents, that makes half sure."""

SIDE_STIFFNESS = 5.0
"""How much neighbours that lie alike agree on their sides, beside how much Gaussians that are sure insist."""

SIDE_SHARPNESS = 4
"""Exponent of the cosine between the axes of neighbours that agree on their sides."""

SIDE_STEPS = 300
"""Most steps of conjugate gradients by which they do."""

SIDE_ERROR = 1e-6
"""Root mean square of the residual at which these end: signs are read off, which lie farther from 0."""

SURFACE_SPREAD = 0.5
"""Within how much of a Gaussian rays begin, standard deviations of its own: as they do where it is baked."""

EMITTER_POINTS = 24
"""Places of a group whose light is traced."""


class SurfacePoints:
    """Random points on Gaussians, where rays that come along their normals see them.

    Args:
        gaussians: The set.
        seed: Of the points.
    """

    def __init__(self, gaussians: Gaussians, seed: int) -> None:
        self._means, self._scales = gaussians.means.astype(np.float64), gaussians.scales.astype(np.float64)
        self._axes = matrices_from_quaternions(gaussians.rotations_wxyz)
        self._rng = np.random.default_rng([seed, 9])

    def at(self, rows: Rows, normals: Doubles) -> FloatArray:
        """One point on each of some Gaussians: the peak of its response along a line, shape (R, 3)."""
        point = SURFACE_SPREAD * self._rng.standard_normal((len(rows), 3))
        slope = np.einsum("ijk,ij->ik", self._axes[rows], normals) / self._scales[rows]
        along = np.einsum("ij,ij->i", point, slope) / np.einsum("ij,ij->i", slope, slope)
        peak = self._scales[rows] * (point - along[:, None] * slope)
        return (self._means[rows] + np.einsum("ijk,ik->ij", self._axes[rows], peak)).astype(np.float32)


def agreed_sides(axes: Doubles, votes: Doubles, near: Pairs) -> Doubles:
    """Signs of axes: as Gaussians vote, and where they are unsure, as neighbours that lie alike do, shape (N,).

    The minimum of ``sum c_i (s_i - sign v_i)^2 + sum w_ij (s_i - sign(a_i a_j) s_j)^2 / 2``, where ``c_i = |v_i|``, by
    conjugate gradients: votes spread along surfaces however far away the next sure one is.

    Args:
        axes: Unit, of either sign, shape (N, 3).
        votes: Above 0: along the axis; farther from 0: surer; shape (N,).
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
    """Follows rays that leave the Gaussians of a capture through it, as paths of light do.

    Args:
        capture: The set.
        renderer: Traces unlit rays in order.
        seed: Of where rays go.
        traced: Called after each direction in which rays were followed, with the number of Gaussians.
    """

    def __init__(
        self,
        capture: Gaussians,
        renderer: Renderer,
        seed: int,
        traced: Callable[[int], object] = lambda count: None,
    ) -> None:
        self._capture, self._renderer, self._traced = capture, renderer, traced
        self._scene = Scene([capture])
        self._points = SurfacePoints(capture, seed)
        self._rng = np.random.default_rng([seed, 4])
        self._order = morton_order(capture.means)  # rays that go side by side are followed together
        self._means = capture.means.astype(np.float64)
        self._offsets = SHADOW_OFFSET * capture.scales.max(axis=1)
        self._extent = float(np.linalg.norm(np.ptp(self._means, axis=0)))

    def facing(self, axes: Doubles, near: Pairs, inside: bool | None, *, has_normals: bool) -> tuple[Doubles, bool]:
        """Normals along given axes that point to the side from which Gaussians are seen, and whether from inside.

        Of an object, that is the side of which the sky is seen; if it is seen from both, as from a floor, the one with
        more of the capture. Of a room it is that with more of it, as behind the walls is nothing.

        Args:
            axes: Unit, of either sign, shape (N, 3).
            near: Pairs of neighbours, in both orders.
            inside: Whether the capture was taken from inside of it; None: if a good part of it sees no sky.
            has_normals: Whether axes are normals that came with the capture, and stay.
        """
        openness, distance, weights = np.zeros((2, len(axes))), np.zeros((2, len(axes))), np.zeros((2, len(axes)))
        rows = self._order
        for direction in even_directions(SIDE_DIRECTIONS):
            cosines = axes[rows] @ direction
            side, cosines = (cosines < 0.0).astype(int), np.abs(cosines)  # grazing rays miss what they should meet
            hits = self._trace(
                rows, np.where(side == 0, 1.0, -1.0)[:, None] * axes[rows], np.tile(direction, (len(axes), 1))
            )
            openness[side, rows] += cosines * hits.transmittance
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
            clipped = np.minimum(openness / OPENNESS_ENOUGH, 1.0)
            by_openness = clipped[0] - clipped[1]
            votes = by_openness + (1.0 - np.abs(by_openness)) * votes
        return agreed_sides(axes, votes, near)[:, None] * axes, inside

    def incident(
        self, normals: Doubles, emitters: Rows, cells: EnvironmentCells, *, stores_directions: bool = False
    ) -> Irradiance:
        """What shines on Gaussians that face along their normals.

        Args:
            normals: Unit, shape (N, 3).
            emitters: The lamp that each is part of, shape (N,); -1: none.
            cells: Of all directions.
            stores_directions: Whether what the capture shows is also kept apart for each cell.
        """
        by_direction = np.zeros((len(cells) if stores_directions else 0, len(normals), 3), np.float16)
        observed, environment = np.zeros((len(normals), 3)), np.zeros((len(normals), len(cells)), np.float32)
        groups = range(int(emitters.max(initial=-1)) + 1)
        hit_sums = np.zeros(len(groups))
        for cell in range(len(cells)):
            rows, directions, shares = self._sampled_directions(normals, cells, cell)
            hits = self._trace(rows, normals[rows], directions)
            alpha = 1.0 - hits.transmittance.astype(np.float64)
            emitter = np.where(hits.gaussian_index >= 0, emitters[hits.gaussian_index], -1)
            is_emitter = emitter >= 0
            hit_sums += np.bincount(emitter[is_emitter], (shares * alpha)[is_emitter], len(groups))
            observed_radiance = (shares * alpha * ~is_emitter)[:, None] * hit_radiance(hits, alpha)
            observed[rows] += observed_radiance
            if stores_directions:
                by_direction[cell, rows] = observed_radiance
            environment[rows, cell] = shares * hits.transmittance
            self._traced(len(normals))
        from_emitters = [self._from_emitter(normals, np.flatnonzero(emitters == emitter)) for emitter in groups]
        shares = np.stack(from_emitters, axis=1) if from_emitters else np.zeros((len(normals), 0))
        brought = shares.sum(axis=0)
        shares *= np.where((brought > 0.0) & (hit_sums > 0.0), hit_sums / np.maximum(brought, 1e-12), 1.0)
        directions = cells.directions if stores_directions else np.zeros((0, 3))
        return Irradiance(observed, environment, shares.astype(np.float32), directions, by_direction)

    def from_environment(self, normals: Doubles, cells: EnvironmentCells) -> FloatArray:
        """Of each cell of the sky, as ``Irradiance.sky``, shape (N, K)."""
        environment = np.zeros((len(normals), len(cells)), np.float32)
        for cell in range(len(cells)):
            rows, directions, shares = self._sampled_directions(normals, cells, cell)
            environment[rows, cell] = shares * self._transmittance(
                rows, normals[rows], directions, np.full(len(rows), np.inf)
            )
            self._traced(len(normals))
        return environment

    def _sampled_directions(
        self, normals: Doubles, cells: EnvironmentCells, cell: int
    ) -> tuple[Rows, Doubles, Doubles]:
        """The Gaussians that a random direction of a cell shines on, the directions, and irradiances over pi."""
        directions = cells.directions_within(cell, len(normals), self._rng)
        cosines = np.einsum("ij,ij->i", normals, directions)
        rows = self._order[cosines[self._order] > 0.0]
        return rows, directions[rows], cosines[rows] * (cells.solid_angles[cell] / np.pi)

    def _from_emitter(self, normals: Doubles, members: Rows) -> Doubles:
        """Irradiance over pi of a lamp of radiance 1, shape (N,), but for one factor.

        The area is that of its Gaussians, which overlap; how much too large that is, rays tell that meet the lamp.
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
            arrived = self._transmittance(rows, normals[rows], legs[rows], distance[rows] - near)
            found[rows] += arrived * at_surface[rows] * at_emitter[rows] / distance[rows] ** 2
        return found * (area.sum() / (np.pi * EMITTER_POINTS))

    def _trace(self, rows: Rows, normals: Doubles, directions: Doubles) -> RayHits:
        """What rays see that leave Gaussians on a side."""
        points = self._points.at(rows, normals)
        return self._renderer.leaving_hits(self._scene, points, directions.astype(np.float32), self._offsets[rows])

    def _transmittance(self, rows: Rows, normals: Doubles, directions: Doubles, distances: Doubles) -> FloatArray:
        """How much light arrives at Gaussians from so far away."""
        points = self._points.at(rows, normals)
        legs, lengths = directions.astype(np.float32), distances.astype(np.float32)
        return self._renderer.leaving_transmittance(self._scene, points, legs, lengths, self._offsets[rows])
