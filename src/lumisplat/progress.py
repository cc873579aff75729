"""How long computations say what they do."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called with a label of the work and the fraction done, 0..1."""


def say_nothing(label: str, fraction: float) -> None:
    """Progress that nobody asked for."""
