"""The sky of which the albedos of a capture are as alike as can be."""

from __future__ import annotations

import numpy as np

from lumisplat.constants.delight import RADIANCE_LEAST
from lumisplat.constants.materials import (
    SKY_NEIGHBOURS,
    SKY_PAIRS,
    SKY_PRIOR,
    SKY_RATE,
    SKY_SEEN,
    SKY_SMOOTHNESS,
)
from lumisplat.math.adam import Adam
from lumisplat.math.arrays import Doubles
from lumisplat.progress import Progress
from lumisplat.relighting.albedo.irradiance import Irradiance
from lumisplat.relighting.albedo.usual import even_radiance, usual_factor
from lumisplat.training.materials.alike_pairs import AlikePairs


def lit_white(white: Irradiance, sky: Doubles) -> Doubles:
    """Radiance of white, matte Gaussians under a sky of radiances, shape (K, 3): shape (N, 3)."""
    return np.maximum(white.total(sky.astype(np.float32), np.zeros((0, 3))), RADIANCE_LEAST)


def sees_sky(white: Irradiance) -> bool:
    """Whether there is a sky to be found."""
    return float(np.median(white.sky.sum(axis=1))) > SKY_SEEN


def fitted_sky(
    outgoing: Doubles,
    white: Irradiance,
    weights: Doubles,
    directions: Doubles,
    *,
    steps: int,
    rng: np.random.Generator,
    report: Progress,
) -> Doubles:
    """Radiances of the sky in K directions, shape (K, 3).

    The albedo of a matte surface is its radiance over that of a white one. What light does to a capture goes by its
    normals and by what is open to the sky, what albedo does goes by neither: so of all skies that one is right under
    which pairs of surfaces, anywhere, that may have one albedo, have it. A brighter sky over darker surfaces looks the
    same: the lightest surfaces have a usual albedo.

    Args:
        outgoing: Radiance of Gaussians, shape (N, 3).
        white: What shines on them.
        weights: How often each is in a pair, shape (N,).
        directions: Of the sky, shape (K, 3).
        steps: How many are made.
        rng: Chooses pairs.
        report: Called with what is being done and the fraction done, 0..1.
    """
    if not sees_sky(white):
        return np.ones((len(directions), 3))
    start = np.full((len(directions), 3), np.log(even_radiance(outgoing, white, weights)))
    chosen = rng.choice(len(outgoing), (2, SKY_PAIRS), p=weights / weights.sum())
    rows, compact = np.unique(chosen, return_inverse=True)
    first, second = compact.reshape(2, SKY_PAIRS)
    pairs, part = AlikePairs(first, second), Irradiance(white.observed[rows], white.sky[rows], white.lamps[rows])
    shown = np.log(np.maximum(outgoing[rows], RADIANCE_LEAST))
    neighbours = nearest_directions(directions)
    moved, adam = start.copy(), Adam.still(start.shape)
    for step in range(steps):
        report("finding the sky", step / steps)
        sky = np.exp(moved)
        light = lit_white(part, sky)
        _, by_log_albedo = pairs.albedo_term(shown - np.log(light))
        by_sky = -(part.sky.T @ (by_log_albedo / light).astype(np.float32)).astype(np.float64) * sky
        by_sky += smoothness_gradient(moved, neighbours) + SKY_PRIOR / len(directions) * (moved - start)
        moved += adam.step(by_sky, SKY_RATE * (1.0 - step / steps))
        moved += start.mean(axis=0) - moved.mean(axis=0)
    sky = np.exp(moved)
    lit = (white.sky @ sky.astype(np.float32)).astype(np.float64)
    return usual_factor(outgoing, white.observed, lit, weights) * sky


def nearest_directions(directions: Doubles) -> np.ndarray:
    """The neighbours of each direction, shape (K, 6)."""
    return np.argsort(-(directions @ directions.T), axis=1, kind="stable")[:, 1 : 1 + SKY_NEIGHBOURS]


def smoothness_gradient(log_sky: Doubles, neighbours: np.ndarray) -> Doubles:
    """Derivatives of the roughness of a sky, shape (K, 3); neighbours are held where they are."""
    return SKY_SMOOTHNESS / len(log_sky) * (log_sky[:, None] - log_sky[neighbours]).sum(axis=1)
