"""Weights running means over frames whose samples depend on the means of earlier frames, in float64."""

from __future__ import annotations

YOUNG_SHARE = 0.5


def mean_weight(count: float, history: float) -> float:
    """Returns how many samples a mean of ``count`` counts for when one is added: half while the mean is young."""
    return YOUNG_SHARE * count if count < history else history - 1.0
