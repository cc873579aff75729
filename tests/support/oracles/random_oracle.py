"""The random numbers of lumisplat.device.math.random once more, in NumPy over whole arrays."""

from __future__ import annotations

import numpy as np

LENS_RADIUS, LENS_ANGLE, BRANCH_LAST = 2**32 - 1, 2**32 - 2, 2**32 - 3
"""Dimensions that are no Gaussian's."""


def mix(word: np.ndarray) -> np.ndarray:
    """The permutation, from its published description: xorshift 16, multiply, xorshift 15, multiply, xorshift 15."""
    word = np.asarray(word, np.uint32)
    with np.errstate(over="ignore"):
        word = (word ^ (word >> 16)) * np.uint32(0x21F0AAAD)
        word = (word ^ (word >> 15)) * np.uint32(0xD35A2D97)
    return word ^ (word >> 15)


def absorbed(sample_key: np.ndarray, counter: np.ndarray | int) -> np.ndarray:
    """One step: the mixed counter is added, and the sum mixed."""
    with np.errstate(over="ignore"):
        return mix(sample_key + mix(np.asarray(counter, np.uint32)))


def sample_keys(pixels: np.ndarray | int, sample: np.ndarray | int = 0, seed: np.ndarray | int = 0) -> np.ndarray:
    """Keys of samples of pixels."""
    return absorbed(absorbed(absorbed(np.uint32(0x6C756D69), seed), pixels), sample)


def draws(sample_key: np.ndarray, dimension: np.ndarray | int) -> np.ndarray:
    """Numbers in [0, 1), float64."""
    return (absorbed(sample_key, dimension) >> 8) * 2.0**-24
