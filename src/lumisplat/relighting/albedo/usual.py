"""How bright the light of a capture is: only its product with albedos is seen, and the lightest of these are usual.

The 95th percentile of albedos in their lightest channel is 0.8 (docs/method/delighting.md).
"""

from __future__ import annotations

import numpy as np

from lumisplat.constants.delight import (
    ALBEDO_HIGH,
    LIGHTEST,
    LIT_LEAST,
    RADIANCE_LEAST,
    SCALE_STEPS,
    SKY_LEAST,
)
from lumisplat.math.arrays import Doubles, weighted_quantile
from lumisplat.relighting.albedo.irradiance import Irradiance


def lit_evenly(incident: Irradiance) -> Doubles:
    """Irradiance over pi of the sky and lamps, each of radiance 1, shape (N,)."""
    return incident.sky.sum(axis=1, dtype=np.float64) + incident.lamps.sum(axis=1, dtype=np.float64)


def even_radiance(outgoing: Doubles, incident: Irradiance, weights: Doubles) -> float:
    """Of a sky and lamps that are grey and the same everywhere; 1 if hardly any of their light arrives anywhere.

    Args:
        outgoing: Radiance of Gaussians, shape (N, 3).
        incident: What shines on them.
        weights: How much they count, at least 0, shape (N,).
    """
    lit = lit_evenly(incident)
    rows = (lit > max(LIT_LEAST * float(np.median(lit)), 1e-9)) & (weights > 0.0)
    if not rows.any():
        return 1.0
    wanted = (outgoing[rows] / ALBEDO_HIGH - incident.observed[rows]).max(axis=1) / lit[rows]
    return max(weighted_quantile(wanted, weights[rows], LIGHTEST), SKY_LEAST)


def usual_factor(outgoing: Doubles, observed: Doubles, lit: Doubles, weights: Doubles) -> float:
    """By what a light is too dark; what Gaussians show each other stays as it was captured.

    In a few rounds, each of which comes nearer by the light's share: where Gaussians are lit mostly by each other, the
    lightest albedos stay between what they were and what is usual.

    Args:
        outgoing: Radiance of Gaussians, shape (N, 3).
        observed: Irradiance over pi of what the capture shows, shape (N, 3).
        lit: Of the light, shape (N, 3).
        weights: How much Gaussians count, at least 0, shape (N,).
    """
    factor = 1.0
    for _ in range(SCALE_STEPS):
        irradiance = np.maximum(observed + factor * lit, RADIANCE_LEAST)
        factor *= weighted_quantile((outgoing / irradiance).max(axis=1), weights, LIGHTEST) / ALBEDO_HIGH
    return factor
