"""Tests whether counts follow expected frequencies."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

LIMIT = 5.0
"""Largest accepted score in standard deviations. Draws come from fixed seeds, so a test that passed once always
passes."""


def chi_square_z(counts: npt.NDArray[np.float64], expected: npt.NDArray[np.float64]) -> float:
    """Returns chi-square as a standard normal score (Wilson and Hilferty 1931); small bins are merged.

    Bins count as small if fewer than 20 draws are expected.
    """
    few = expected < 20.0
    counts = np.append(counts[~few], counts[few].sum())
    expected = np.append(expected[~few], max(expected[few].sum(), 1e-9))
    if expected[-1] < 20.0:  # too few for chi-square even together
        assert counts[-1] < 60.0
        counts, expected = counts[:-1], expected[:-1]
    freedom = max(len(counts) - 1, 1)
    variance = 2.0 / (9.0 * freedom)
    ratio = ((counts - expected) ** 2 / expected).sum() / freedom
    return float((np.cbrt(ratio) - (1.0 - variance)) / math.sqrt(variance))
