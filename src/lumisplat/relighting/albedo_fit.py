"""Fits the light under which surfaces of similar chromaticity get similar albedos, by Gauss-Newton over pairs.

The environment is piecewise constant over cells of the sphere; the cells are smaller where the environment is bright.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lumisplat.constants import RADIANCE_LEAST
from lumisplat.math.arrays import Doubles, FloatArray, Rows
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
"""Two environment cells are neighbours if the angle between their centres is below this times the sum of their angular
radii. The angular radius of a cell is that of a disc with the cell's solid angle."""

RANDOM_PAIR_SHARE = 0.25
"""Ratio of random pairs of Gaussians to pairs of neighbours in the albedo fit. Random pairs are fewer, because distant
surfaces of similar chromaticity have one albedo less often than neighbours do."""

NEAR_CHROMA_WIDTH, CHROMA_WIDTH = 0.1, 0.03
"""Standard deviations assumed for the difference in chromaticity, natural logarithms of channels, between two Gaussians
with the same albedo: neighbours, and any two. Neighbours more often share an albedo, so that their difference may be
the colour of a light that the fit has not found yet."""

EDGE_WIDTHS = (0.2, 0.1)
"""Widths of the Cauchy weight on the difference of a pair's albedos, in natural logarithms: for the first and for the
second solve. Pairs with larger differences are likely edges of textures."""

RANDOM_PAIRS_MIN = 1000
"""Smallest number of random pairs of Gaussians in the albedo fit."""

LIGHT_STEPS = 25
"""Maximum number of Gauss-Newton steps for the light's radiances."""

LIGHT_STEP_MAX = 0.7
"""Largest change of the natural logarithm of a radiance in one Gauss-Newton step; longer steps are shortened."""

LIGHT_CONVERGED = 1e-3
"""The Gauss-Newton steps end when no radiance changes by more than this, in natural logarithm."""

HESSIAN_KEPT = 0.1
"""Gauss-Newton steps keep the Hessian once no radiance changed by more than this, in natural logarithm. The weights of
the pairs then converge slowest, so that a new Hessian in each step would not save steps."""

PAIRS_AT_ONCE = 1024
"""Number of pairs of Gaussians whose derivatives are computed at once, 2 MB."""

ENVIRONMENT_SMOOTHNESS = 3e-3
"""Weight of the squared differences between log radiances of neighbouring environment cells; all pairs of Gaussians
together have weight 1."""

LIGHT_PRIOR = 3e-4
"""Weight of the squared log ratio of a radiance to its initial value; all pairs of Gaussians together have weight 1."""

IRRADIANCE_WEIGHT_MAX = 3.0
"""Irradiance from environment and emitters, relative to the median Gaussian's, above which a Gaussian's weight stops
growing, because the irradiance's error grows, too. A lampshade thus counts at most like nine pieces of wall. In trained
rooms, 2 to 4 % of the Gaussians receive more."""


@dataclass(frozen=True, slots=True, eq=False)
class EnvironmentCells:
    """K square cells of the equal-area map of directions (`directions_of_square`), each with constant radiance."""

    corners: Doubles
    """Lower corner of each cell in the unit square onto which directions are mapped, shape (K, 2)."""
    sides: Doubles
    """Side of each cell in the unit square onto which directions are mapped, shape (K,)."""

    @staticmethod
    def even(across: int) -> EnvironmentCells:
        """Returns ``across`` x ``across`` cells of equal size that cover the sphere."""
        v, u = np.divmod(np.arange(across * across), across)
        return EnvironmentCells(np.stack([u, v], axis=1) / across, np.full(across * across, 1.0 / across))

    def __len__(self) -> int:
        return len(self.sides)

    @property
    def solid_angles(self) -> Doubles:
        """Solid angles of the cells, sr, shape (K,)."""
        return 4.0 * np.pi * self.sides**2

    @property
    def directions(self) -> Doubles:
        """Unit directions of the cells' centres, shape (K, 3)."""
        return directions_of_square(self.corners + 0.5 * self.sides[:, None])

    @property
    def neighbours(self) -> Rows:
        """Indices of the S pairs of adjacent cells, the smaller index first, shape (S, 2)."""
        radii = np.sqrt(self.solid_angles / np.pi)
        angles = np.arccos(np.clip(self.directions @ self.directions.T, -1.0, 1.0))
        first, second = np.nonzero(np.triu(angles < CELL_REACH * (radii[:, None] + radii), 1))
        return np.stack([first, second], axis=1)

    def of(self, rows: Rows) -> EnvironmentCells:
        """Returns the cells that the indices ``rows`` select, in the order of ``rows``."""
        return EnvironmentCells(self.corners[rows], self.sides[rows])

    def joined(self, others: EnvironmentCells) -> EnvironmentCells:
        """Returns the cells of this object followed by those of ``others``."""
        return EnvironmentCells(
            np.concatenate([self.corners, others.corners]), np.concatenate([self.sides, others.sides])
        )

    def parts(self, across: int) -> EnvironmentCells:
        """Divides each cell into ``across`` x ``across`` smaller ones; the parts follow the order of their cells."""
        v, u = np.divmod(np.arange(across * across), across)
        within = np.stack([u, v], axis=1)[None] * (self.sides[:, None, None] / across)
        return EnvironmentCells(
            (self.corners[:, None] + within).reshape(-1, 2), np.repeat(self.sides / across, across * across)
        )

    def directions_within(self, cell: int, count: int, rng: np.random.Generator) -> Doubles:
        """Samples ``count`` unit directions uniformly within the solid angle of cell number ``cell``, (count, 3)."""
        return directions_of_square(self.corners[cell] + self.sides[cell] * rng.random((count, 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """Radiances of K environment cells and L emitters, linear, in units of display white."""

    environment: Doubles
    """Linear radiance of each of K environment cells, in units of display white, shape (K, 3)."""
    emitters: Doubles
    """Linear radiance of each of L emitters in the capture, in units of display white, shape (L, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class AlbedoPairFit:
    """Finds the light for which pairs among N Gaussians get the most similar albedos.

    Albedo is outgoing radiance over irradiance / pi. If two surfaces have the same albedo, the logarithm of outgoing
    radiance differs between them by as much as the logarithm of irradiance. Other pairs are edges of textures and get
    low weights. This is Retinex with pairs anywhere in the capture, and with a model of the light instead of a
    smoothness assumption.
    """

    outgoing: Doubles
    """Linear radiance that each Gaussian reflects, in units of display white, shape (N, 3)."""
    incident: Irradiance
    """Irradiance over pi at the Gaussians, split into the light of the capture, each environment cell and each
    emitter."""
    pairs: Rows
    """Indices of the P pairs of Gaussians whose albedos are compared, shape (P, 2)."""
    chroma_widths: Doubles
    """Standard deviation assumed for the difference in chromaticity of each pair with one albedo, shape (P,)."""
    cells: EnvironmentCells
    """The K environment cells whose radiances are fitted."""

    def solved(self, start: Light) -> Light:
        """Fits the radiances from ``start``: two solves, the second with a narrower Cauchy weight (`EDGE_WIDTHS`).

        The narrower weight reduces the influence of texture edges further.
        """
        light = start
        for width in EDGE_WIDTHS:
            light = self._improved(light, width)
        return light

    def _improved(self, start: Light, width: float) -> Light:
        """Takes up to `LIGHT_STEPS` Gauss-Newton steps with Cauchy weights of one width (`EDGE_WIDTHS`)."""
        first = np.concatenate([start.environment, start.emitters])
        radiances, prior = first.copy(), self._prior()
        rows, pairs = np.unique(self.pairs, return_inverse=True)  # few of the Gaussians are in pairs
        pairs = pairs.reshape(-1, 2)
        columns = np.concatenate([self.incident.environment[rows], self.incident.emitters[rows]], axis=1)
        log_outgoing, observed = np.log(np.maximum(self.outgoing[rows], RADIANCE_LEAST)), self.incident.observed[rows]
        inverses, largest = np.empty((3, *prior.shape)), math.inf
        for _ in range(LIGHT_STEPS):
            irradiance = np.maximum(observed + columns @ radiances.astype(np.float32), RADIANCE_LEAST)
            differences = log_outgoing - np.log(irradiance)
            differences = differences[pairs[:, 0]] - differences[pairs[:, 1]]
            weights = self._weights(differences, width)
            if largest > HESSIAN_KEPT:
                for channel in range(3):
                    slopes = columns * (radiances[:, channel] / irradiance[:, channel, None]).astype(np.float32)
                    inverses[channel] = np.linalg.inv(_hessian(slopes, pairs, weights[:, channel]) + prior)
            gradient = radiances * (columns.T @ _pulls(pairs, weights * differences, irradiance))
            gradient += prior @ np.log(radiances / first)
            steps = -np.einsum("cij,jc->ic", inverses, gradient)
            steps *= np.minimum(1.0, LIGHT_STEP_MAX / np.maximum(np.abs(steps).max(axis=0, initial=0.0), 1e-12))
            radiances *= np.exp(steps)
            largest = float(np.abs(steps).max(initial=0.0))
            if largest < LIGHT_CONVERGED:
                break
        return Light(radiances[: len(self.cells)], radiances[len(self.cells) :])

    def _weights(self, differences: Doubles, width: float) -> Doubles:
        """Returns the weight of each of P pairs per channel: chromaticity similarity times Cauchy weight, (P, 3).

        Args:
            differences: Differences of the natural logarithms of the pairs' albedos, shape (P, 3).
            width: Width of the Cauchy weight, natural logarithm of albedo.
        """
        alike = chroma_similarity(differences, self.chroma_widths[:, None]) / len(differences)
        return alike / (1.0 + (differences / width) ** 2)

    def _prior(self) -> Doubles:
        """Returns the prior's quadratic form on log radiances of K cells and L emitters, shape (K + L, K + L).

        The prior prefers equal radiances of neighbouring cells, and radiances near their initial values.
        """
        emitters, share = self.incident.emitters.shape[1], self.cells.solid_angles / (4.0 * np.pi)
        form = LIGHT_PRIOR * np.diag(np.concatenate([share, np.full(emitters, 1.0 / max(emitters, 1))]))
        first, second = self.cells.neighbours.T
        weights = ENVIRONMENT_SMOOTHNESS * np.sqrt(share[first] * share[second])
        np.add.at(form, (first, first), weights)
        np.add.at(form, (second, second), weights)
        np.add.at(form, (first, second), -weights)
        np.add.at(form, (second, first), -weights)
        return form


def _hessian(slopes: FloatArray, pairs: Rows, weights: Doubles) -> Doubles:
    """Returns the Gauss-Newton Hessian, (M, M), of half the weighted squared differences of P pairs.

    Args:
        slopes: Derivatives of the logarithms of irradiance with respect to M unknowns, one row per surface, (N, M).
        pairs: Indices of the pairs' surfaces, shape (P, 2).
        weights: Weights of the pairs, shape (P,).
    """
    hessian = np.zeros((slopes.shape[1],) * 2)
    roots = np.sqrt(weights).astype(np.float32)
    # In parts that stay in the caches.
    jacobian, other = np.empty((2, PAIRS_AT_ONCE, slopes.shape[1]), np.float32)
    for begin in range(0, len(pairs), PAIRS_AT_ONCE):
        part = slice(begin, begin + PAIRS_AT_ONCE)
        first, second = pairs[part].T
        jacobian, other = jacobian[: len(first)], other[: len(first)]
        np.take(slopes, second, axis=0, out=jacobian, mode="clip")
        np.take(slopes, first, axis=0, out=other, mode="clip")
        jacobian -= other
        jacobian *= roots[part, None]
        hessian += jacobian.T @ jacobian
    return hessian


def _pulls(pairs: Rows, weighted: Doubles, irradiance: Doubles) -> FloatArray:
    """Returns the derivatives of half the weighted squared differences of P pairs by N surfaces' irradiance, (N, 3).

    Args:
        pairs: Indices of the pairs' surfaces, shape (P, 2).
        weighted: Differences of the logarithms of the pairs' albedos, times their weights, shape (P, 3).
        irradiance: Irradiance over pi of the surfaces, shape (N, 3).
    """
    sums = [
        np.bincount(pairs[:, 1], channel, len(irradiance)) - np.bincount(pairs[:, 0], channel, len(irradiance))
        for channel in weighted.T
    ]
    return (np.stack(sums, axis=1) / irradiance).astype(np.float32)


def initial_light(outgoing: Doubles, incident: Irradiance) -> Light:
    """Returns one grey radiance for all cells and emitters, under which the lightest surfaces have an albedo of 0.8.

    With emitters, each Gaussian is weighted by the square of its irradiance from cells and emitters, because the
    relative error of the radiance is that of the irradiance. Without the weights, Gaussians that haze hides from an
    emitter would make the emitter many times too bright.
    """
    irradiance = unit_irradiance(incident)
    exponent = 2.0 if incident.emitters.size else 0.0
    weights = np.minimum(irradiance / max(float(np.median(irradiance)), 1e-9), IRRADIANCE_WEIGHT_MAX) ** exponent
    radiance = constant_radiance(outgoing, incident, weights)
    return Light(
        np.full((incident.environment.shape[1], 3), radiance), np.full((incident.emitters.shape[1], 3), radiance)
    )


def with_typical_albedos(light: Light, outgoing: Doubles, incident: Irradiance) -> Light:
    """Scales all radiances of a light by one factor that gives the lightest surfaces an albedo of 0.8."""
    irradiance = incident.total(light.environment, light.emitters) - incident.observed
    factor = typical_albedo_factor(outgoing, incident.observed, irradiance, np.ones(len(irradiance)))
    return Light(factor * light.environment, factor * light.emitters)


def with_white_balance(light: Light, incident: Irradiance) -> Light:
    """Scales each channel of a light so that the median irradiance is grey, as a camera's white balance makes it."""
    irradiance = incident.total(light.environment, light.emitters)
    logs = np.log(np.maximum(irradiance, RADIANCE_LEAST))
    factors = np.exp(-np.median(logs - logs.mean(axis=1, keepdims=True), axis=0))
    return Light(factors * light.environment, factors * light.emitters)


def albedo_pairs(
    near: Pairs, reflects: Rows, count: int, rng: np.random.Generator, *, opaque: bool
) -> tuple[Rows, Doubles]:
    """Chooses P pairs of Gaussians whose albedos are compared: neighbours, then random ones.

    Colours of translucent Gaussians are parts of a blend, so they differ among neighbours by more than the light does:
    their pairs are all random, and their chromaticities may differ as much as neighbours' may.

    Args:
        near: Pairs of neighbours, in both orders.
        reflects: Indices of the Gaussians that may be compared.
        count: Largest number of pairs of neighbours; of random ones, if the Gaussians are translucent.
        rng: Random generator.
        opaque: Whether the Gaussians are opaque.

    Returns:
        Indices of the pairs, shape (P, 2), and their `AlbedoPairFit.chroma_widths`, shape (P,).
    """
    if not opaque:
        return rng.choice(reflects, (count, 2)), np.full(count, NEAR_CHROMA_WIDTH)
    beside = np.stack([near.first, near.second], axis=1)[near.first < near.second]
    beside = rng.permutation(beside[np.isin(beside, reflects).all(axis=1)])[:count]
    far = rng.choice(reflects, (max(int(RANDOM_PAIR_SHARE * len(beside)), RANDOM_PAIRS_MIN), 2))
    widths = np.repeat([NEAR_CHROMA_WIDTH, CHROMA_WIDTH], [len(beside), len(far)])
    return np.concatenate([beside, far]), widths
