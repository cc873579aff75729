"""Chooses the lights of a light grid's cells in float64, with their probabilities.

A cell keeps the lights of the k smallest exponential draws divided by weights (Efraimidis and Spirakis 2006). Given the
next value tau, each light is kept independently with probability 1 - exp(-w tau) (Cohen and Kaplan 2007), so the sum of
f / p over kept lights estimates the sum of f.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from support.oracles.light_oracle import LUMINANCE
from support.oracles.random_oracle import absorbed, mix

Array = npt.NDArray[np.float64]


def exponential_draws(key: int, seed: int, frame: int, count: int) -> Array:
    """Returns the exponential draw of each light in a cell and frame."""
    word = mix(np.uint32(0x63616368) + mix(np.uint32(key & 0xFFFFFFFF)))
    for counter in (key >> 32, seed, frame):
        word = absorbed(word, counter)
    steps = absorbed(word, np.arange(count)) >> 8
    return -np.log1p(-(steps + 0.5) * 2.0**-24)


def chosen_lights(draws: Array, weights: Array, count: int) -> tuple[npt.NDArray[np.intp], Array]:
    """Returns the indices of the lights that a cell keeps, ascending, and their probabilities."""
    reached = np.flatnonzero(weights > 0.0)
    if len(reached) <= count:
        return reached, np.ones(len(reached))
    ranks = draws[reached] / weights[reached]
    order = np.argsort(ranks, kind="stable")
    chosen = np.sort(reached[order[:count]])
    return chosen, -np.expm1(-weights[chosen] * ranks[order[count]])


def point_weights(positions: Array, powers: Array, center: Array, half: float) -> Array:
    """Returns weights of point lights without range; distances below half the cell's diagonal count as that."""
    distance2 = ((positions - center) ** 2).sum(axis=1)
    return powers @ LUMINANCE / np.maximum(distance2, half**2)
