"""Figures of metrics: their means, and how tables and JSON show them."""

from __future__ import annotations

import math
from collections.abc import Sequence

Figures = dict[str, float]
"""By the names of metrics; NaN: there is none."""

_DIGITS = {"psnr": 2, "ncm_ab": 2}


def mean(values: Sequence[float]) -> float:
    """The mean of the values that are not NaN."""
    existing = [value for value in values if not math.isnan(value)]
    return sum(existing) / len(existing) if existing else math.nan


def plain(figures: Figures) -> dict[str, float | str | None]:
    """Figures as JSON can hold them: NaN is null, infinity "inf"."""
    return {
        name: None if math.isnan(value) else "inf" if math.isinf(value) else value for name, value in figures.items()
    }


def cells(figures: Figures) -> list[str]:
    """Figures as a table shows them."""
    return [digits(name, value) for name, value in figures.items()]


def digits(name: str, value: float) -> str:
    """A figure as a table shows it."""
    return "-" if math.isnan(value) else f"{value:.{_DIGITS.get(name, 4)}f}"
