"""Fits the light for which surfaces get the most similar albedos: Gauss-Newton over pairs of Gaussians.

The environment is a set of cells of equal area, finer where it is bright.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.constants import RADIANCE_LEAST
from lumisplat.math.arrays import Doubles, Rows
from lumisplat.math.directions import directions_of_square
from lumisplat.relighting.irradiance import (
    Irradiance,
    chroma_similarity,
    constant_radiance,
    typical_albedo_factor,
    unit_irradiance,
)
from lumisplat.scene.ops.neighbours import Pairs

CELL_REACH = 1.3
"""How far apart the centres of neighbouring cells of the sky may be, in sums of the radii of discs as large."""

RANDOM_PAIR_SHARE = 0.25
"""Pairs of any Gaussians that are compared, beside one of neighbours: things of like chroma are often of one albedo,
and neighbours more often."""

CHROMA_WIDTH = 0.03
"""Difference of chromaticity, natural logarithm, of Gaussians that may have one albedo."""

EDGE_WIDTHS = (0.2, 0.1)
"""Differences of albedo, natural logarithm, from which on they are rather edges (Cauchy): first and last."""

RANDOM_PAIRS_MIN = 1000
"""Such pairs, at least."""

LIGHT_STEPS = 25
"""Steps of Gauss-Newton, at most."""

LIGHT_STEP_MAX = 0.7
"""Longest of them, natural logarithm of radiances."""

LIGHT_CONVERGED = 1e-3
"""Largest change of a radiance, natural logarithm, at which they end."""

ENVIRONMENT_SMOOTHNESS = 3e-3
"""Weight of differences between neighbouring directions of the sky, beside one pair of Gaussians."""

LIGHT_PRIOR = 3e-4
"""Weight of a radiance's distance from that which it begins with, likewise."""

IRRADIANCE_WEIGHT_MAX = 3.0
"""Light of lamps at a Gaussian, in medians, from which on it tells that no better, for its error grows with it: a shade
beside a lamp counts as nine walls at most. Of trained rooms, 2 to 4 % of the Gaussians have more."""


@dataclass(frozen=True, slots=True, eq=False)
class EnvironmentCells:
    """K squares of the map of all directions (`directions_of_square`), in which areas are solid angles."""

    corners: Doubles
    """The lowest ones, 0..1, shape (K, 2)."""
    sides: Doubles
    """Their lengths, shape (K,)."""

    @staticmethod
    def even(across: int) -> EnvironmentCells:
        """``across`` times ``across`` of one size."""
        v, u = np.divmod(np.arange(across * across), across)
        return EnvironmentCells(np.stack([u, v], axis=1) / across, np.full(across * across, 1.0 / across))

    def __len__(self) -> int:
        return len(self.sides)

    @property
    def solid_angles(self) -> Doubles:
        """In sr, shape (K,)."""
        return 4.0 * np.pi * self.sides**2

    @property
    def directions(self) -> Doubles:
        """Of their centres, unit, shape (K, 3)."""
        return directions_of_square(self.corners + 0.5 * self.sides[:, None])

    @property
    def neighbours(self) -> Rows:
        """Pairs of cells beside each other, shape (S, 2)."""
        radii = np.sqrt(self.solid_angles / np.pi)
        angles = np.arccos(np.clip(self.directions @ self.directions.T, -1.0, 1.0))
        first, second = np.nonzero(np.triu(angles < CELL_REACH * (radii[:, None] + radii), 1))
        return np.stack([first, second], axis=1)

    def of(self, rows: Rows) -> EnvironmentCells:
        """Some of them."""
        return EnvironmentCells(self.corners[rows], self.sides[rows])

    def joined(self, others: EnvironmentCells) -> EnvironmentCells:
        """These, and others after them."""
        return EnvironmentCells(
            np.concatenate([self.corners, others.corners]), np.concatenate([self.sides, others.sides])
        )

    def parts(self, across: int) -> EnvironmentCells:
        """Each in ``across`` times ``across``, one after the other."""
        v, u = np.divmod(np.arange(across * across), across)
        within = np.stack([u, v], axis=1)[None] * (self.sides[:, None, None] / across)
        return EnvironmentCells(
            (self.corners[:, None] + within).reshape(-1, 2), np.repeat(self.sides / across, across * across)
        )

    def directions_within(self, cell: int, count: int, rng: np.random.Generator) -> Doubles:
        """Random directions of a cell, even in solid angle, unit, shape (count, 3)."""
        return directions_of_square(self.corners[cell] + self.sides[cell] * rng.random((count, 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """Radiances, linear, in units of display white."""

    environment: Doubles
    """Shape (K, 3)."""
    emitters: Doubles
    """Shape (L, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class AlbedoPairFit:
    """The light of which pairs of Gaussians get the most alike albedos.

    Albedo is outgoing radiance over irradiance over pi. Of surfaces with one albedo, the logarithms of both differ by
    as much; pairs that differ otherwise are edges of textures, and count little (Retinex, with pairs anywhere and
    a model of the light in place of smoothness).
    """

    outgoing: Doubles
    """Radiance of Gaussians, shape (N, 3)."""
    incident: Irradiance
    """What shines on them."""
    pairs: Rows
    """Of Gaussians, shape (P, 2)."""
    cells: EnvironmentCells
    """Of the sky."""

    def solved(self, start: Light) -> Light:
        """The light, from one to begin with; edges are told apart the more finely the nearer it is."""
        light = start
        for width in EDGE_WIDTHS:
            light = self._improved(light, width)
        return light

    def _improved(self, start: Light, width: float) -> Light:
        """Steps of Gauss-Newton with one width of edges."""
        first = np.concatenate([start.environment, start.emitters])
        radiances, prior = first.copy(), self._prior()
        rows, pairs = np.unique(self.pairs, return_inverse=True)  # of many Gaussians, few are in pairs
        first_row, second_row = pairs.reshape(-1, 2).T
        columns = np.concatenate([self.incident.environment[rows], self.incident.emitters[rows]], axis=1)
        log_outgoing, observed = np.log(np.maximum(self.outgoing[rows], RADIANCE_LEAST)), self.incident.observed[rows]
        for _ in range(LIGHT_STEPS):
            irradiance = np.maximum(observed + columns @ radiances, RADIANCE_LEAST)
            differences = log_outgoing - np.log(irradiance)
            differences = differences[first_row] - differences[second_row]
            weights = self._weights(differences, width)
            largest = 0.0
            for channel in range(3):
                slopes = columns * (radiances[:, channel] / irradiance[:, channel, None]).astype(np.float32)
                jacobian = slopes[second_row] - slopes[first_row]
                weighted = jacobian * weights[:, channel, None].astype(np.float32)
                change = np.log(radiances[:, channel] / first[:, channel])
                hessian = (weighted.T @ jacobian).astype(np.float64) + prior
                gradient = weighted.T @ differences[:, channel] + prior @ change
                step = -np.linalg.solve(hessian, gradient)
                step *= min(1.0, LIGHT_STEP_MAX / max(float(np.abs(step).max(initial=0.0)), 1e-12))
                radiances[:, channel] *= np.exp(step)
                largest = max(largest, float(np.abs(step).max(initial=0.0)))
            if largest < LIGHT_CONVERGED:
                break
        return Light(radiances[: len(self.cells)], radiances[len(self.cells) :])

    def _weights(self, differences: Doubles, width: float) -> Doubles:
        """How much pairs count, shape (P, 3)."""
        alike = chroma_similarity(differences, CHROMA_WIDTH) / len(differences)
        return alike / (1.0 + (differences / width) ** 2)

    def _prior(self) -> Doubles:
        """The quadratic form of changes of light: smooth over the sky, and small; shape (K + L, K + L)."""
        emitters, share = self.incident.emitters.shape[1], self.cells.solid_angles / (4.0 * np.pi)
        form = LIGHT_PRIOR * np.diag(np.concatenate([share, np.full(emitters, 1.0 / max(emitters, 1))]))
        first, second = self.cells.neighbours.T
        weights = ENVIRONMENT_SMOOTHNESS * np.sqrt(share[first] * share[second])
        np.add.at(form, (first, first), weights)
        np.add.at(form, (second, second), weights)
        np.add.at(form, (first, second), -weights)
        np.add.at(form, (second, first), -weights)
        return form


def initial_light(outgoing: Doubles, incident: Irradiance) -> Light:
    """Grey, the same from everywhere, and so much that the lightest surfaces have a usual albedo.

    Of lamps, Gaussians count by the square of the light that reaches them: what is wrong about that light makes a
    radiance wrong by as much, divided by it. Without, some that fog hides from a lamp make it many times too bright.
    """
    irradiance = unit_irradiance(incident)
    exponent = 2.0 if incident.emitters.size else 0.0
    weights = np.minimum(irradiance / max(float(np.median(irradiance)), 1e-9), IRRADIANCE_WEIGHT_MAX) ** exponent
    radiance = constant_radiance(outgoing, incident, weights)
    return Light(
        np.full((incident.environment.shape[1], 3), radiance), np.full((incident.emitters.shape[1], 3), radiance)
    )


def with_typical_albedos(light: Light, outgoing: Doubles, incident: Irradiance) -> Light:
    """The light, brighter or darker by one factor, so that the lightest surfaces have a usual albedo."""
    irradiance = incident.total(light.environment, light.emitters) - incident.observed
    factor = typical_albedo_factor(outgoing, incident.observed, irradiance, np.ones(len(irradiance)))
    return Light(factor * light.environment, factor * light.emitters)


def albedo_pairs(near: Pairs, reflects: Rows, count: int, rng: np.random.Generator) -> Rows:
    """Pairs whose albedos are compared: at most ``count`` of neighbours, and some of any, shape (P, 2).

    Args:
        near: Pairs of neighbours, in both orders.
        reflects: Gaussians that may be compared.
        count: Of pairs of neighbours.
        rng: Chooses.
    """
    beside = np.stack([near.first, near.second], axis=1)[near.first < near.second]
    beside = rng.permutation(beside[np.isin(beside, reflects).all(axis=1)])[:count]
    return np.concatenate(
        [beside, rng.choice(reflects, (max(int(RANDOM_PAIR_SHARE * len(beside)), RANDOM_PAIRS_MIN), 2))]
    )
