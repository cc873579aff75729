"""The float64 twin of the light grid: which of many lights a cell keeps, and how probable that was.

Efraimidis and Spirakis 2006: the k smallest of exponential draws over weights. Given the next one, tau, each light is
among them with the probability 1 - exp(-w tau), independently (Cohen and Kaplan 2007): the sum of f / p is that of f.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from support.oracles.light_oracle import LUMINANCE
from support.oracles.random_oracle import absorbed, mix

Array = npt.NDArray[np.float64]


def exponential_draws(key: int, seed: int, frame: int, count: int) -> Array:
    """Of each light in a cell, in a frame."""
    word = mix(np.uint32(0x63616368) + mix(np.uint32(key & 0xFFFFFFFF)))
    for counter in (key >> 32, seed, frame):
        word = absorbed(word, counter)
    steps = absorbed(word, np.arange(count)) >> 8
    return -np.log1p(-(steps + 0.5) * 2.0**-24)


def chosen_lights(draws: Array, weights: Array, count: int) -> tuple[npt.NDArray[np.intp], Array]:
    """Numbers of the lights that a cell keeps, ascending, and the probability of each."""
    reached = np.flatnonzero(weights > 0.0)
    if len(reached) <= count:
        return reached, np.ones(len(reached))
    ranks = draws[reached] / weights[reached]
    order = np.argsort(ranks, kind="stable")
    chosen = np.sort(reached[order[:count]])
    return chosen, -np.expm1(-weights[chosen] * ranks[order[count]])


def point_weights(positions: Array, powers: Array, center: Array, half: float) -> Array:
    """Weights of points without range: their distance counts as half the cell's diagonal at least."""
    distance2 = ((positions - center) ** 2).sum(axis=1)
    return powers @ LUMINANCE / np.maximum(distance2, half**2)
