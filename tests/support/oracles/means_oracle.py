"""The float64 twin of means over frames of what depends on the means of other frames."""

from __future__ import annotations

YOUNG_SHARE = 0.5


def mean_weight(count: float, history: float) -> float:
    """For how many samples a mean of ``count`` counts when one more is added: half of them while it is young."""
    return YOUNG_SHARE * count if count < history else history - 1.0
