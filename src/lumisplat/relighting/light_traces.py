"""Whether a light leaves traces on captured surfaces: they are brighter where it would shine on them.

Luminance is explained by what is known, and then by one more light (docs/method/relighting.md#traces-of-light).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lumisplat.constants import TRACE_DIRECTIONS, TRACE_FLOOR, TRACE_RIDGE, TRACE_STEPS
from lumisplat.constants.metrics import HUBER_WIDTH, MAD_PER_DEVIATION
from lumisplat.math.arrays import Doubles, Flags
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.relighting.captured_surfaces import CapturedSurfaces

_EVEN = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
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
    known: Doubles
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
        even = np.stack([normals[:, i] * normals[:, j] for i, j in _EVEN], axis=1)
        sky = cosines @ sh_basis(directions, degree) * (4.0 * np.pi / len(directions))
        known = np.concatenate([even, sky], axis=1)
        return cls(surfaces, known, _robust_weights(known, surfaces.luminance))

    def with_light(self, irradiance: Doubles) -> Shading:
        """The same with one more light known."""
        return replace(self, known=np.column_stack([self.known, irradiance]))

    def traces(self, irradiances: Doubles, counted: Flags | None = None) -> list[Trace]:
        """The trace of each of several lights alone.

        Args:
            irradiances: Of surfaces, any unit, a column each, shape (M, L).
            counted: Which surfaces count, shape (M,); None: all.
        """
        weights = self.weights if counted is None else self.weights * counted
        both = np.column_stack([self.surfaces.luminance, irradiances])
        left = both - _explained(self.known, both, weights)
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
    open_ways = surfaces.cells.is_free(np.broadcast_to(center, directions.shape), directions)
    # The mean of a half space of unit vectors has length 1/4.
    return -4.0 * np.mean(open_ways[:, None] * directions, axis=0)


def _robust_weights(known: Doubles, luminance: Doubles) -> Doubles:
    """Weights of squared residuals, relative to the luminance and by Huber's loss, shape (M,)."""
    weights = np.ones_like(luminance)
    if not luminance.size:
        return weights
    floor = max(TRACE_FLOOR * float(np.median(luminance)), 1e-12)
    for _ in range(TRACE_STEPS):
        explained = _explained(known, luminance, weights)
        scale = 1.0 / np.maximum(explained, floor)
        relative = np.abs(luminance - explained) * scale
        width = max(HUBER_WIDTH / MAD_PER_DEVIATION * float(np.median(relative)), 1e-6)
        weights = scale**2 * np.minimum(1.0, width / np.maximum(relative, 1e-12))
    return weights


def _explained(known: Doubles, values: Doubles, weights: Doubles) -> Doubles:
    """The part of values, shape (M,) or (M, L), that the columns of ``known`` explain: weighted least squares."""
    weighted = known * weights[:, None]
    gram = weighted.T @ known
    gram += TRACE_RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(known @ np.linalg.solve(gram, weighted.T @ values), np.float64)
