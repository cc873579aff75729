"""Computes the random numbers of lumisplat.device.math.random independently, in NumPy on whole arrays."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

LENS_RADIUS, LENS_ANGLE, BRANCH_LAST = 2**32 - 1, 2**32 - 2, 2**32 - 3
"""Dimensions that are not indices of Gaussians."""


def mix(word: npt.ArrayLike) -> np.ndarray:
    """Permutes words as published: xorshift 16, multiply, xorshift 15, multiply, xorshift 15."""
    word = np.asarray(word, np.uint32)
    with np.errstate(over="ignore"):
        word = (word ^ (word >> 16)) * np.uint32(0x21F0AAAD)
        word = (word ^ (word >> 15)) * np.uint32(0xD35A2D97)
    return word ^ (word >> 15)


def absorbed(sample_key: np.ndarray | np.uint32, counter: npt.ArrayLike) -> np.ndarray:
    """Combines a key with a counter into a new key: adds the mixed counter to the key, and mixes the sum."""
    with np.errstate(over="ignore"):
        return mix(sample_key + mix(np.asarray(counter, np.uint32)))


def sample_keys(pixels: npt.ArrayLike, sample: npt.ArrayLike = 0, seed: npt.ArrayLike = 0) -> np.ndarray:
    """Returns the random keys of samples of pixels."""
    return absorbed(absorbed(absorbed(np.uint32(0x6C756D69), seed), pixels), sample)


def draws(sample_key: np.ndarray, dimension: npt.ArrayLike) -> np.ndarray:
    """Returns the random numbers of sample keys in some dimensions, float64 in [0, 1)."""
    return (absorbed(sample_key, dimension) >> 8) * 2.0**-24
