"""Adam for a few parameters of each photograph, on the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.constants.training import ADAM_BETA_1, ADAM_BETA_2, ADAM_EPSILON
from lumisplat.math.arrays import Doubles


@dataclass(frozen=True, slots=True, eq=False)
class AdamRows:
    """Moments of the parameters of photographs, a row each; a row moves when the turn of its photograph comes."""

    first: Doubles
    """Shape (K, P)."""
    second: Doubles
    """Shape (K, P)."""
    turns: Doubles
    """How often each has moved, shape (K,)."""

    @classmethod
    def still(cls, count: int, parameters: int) -> AdamRows:
        """Of parameters that have not moved yet."""
        return cls(np.zeros((count, parameters)), np.zeros((count, parameters)), np.zeros(count))

    def state(self, name: str) -> dict[str, Doubles]:
        """All of it, by names that begin with ``name``."""
        return {f"{name}.{part}": getattr(self, part) for part in ("first", "second", "turns")}

    def step(self, number: int, gradient: Doubles) -> Doubles:
        """How far the parameters of a photograph move against their derivatives, at a rate of 1.

        Args:
            number: The photograph.
            gradient: Derivatives of the loss, shape (P,).
        """
        self.turns[number] += 1.0
        first, second, turn = self.first[number], self.second[number], self.turns[number]
        first += (1.0 - ADAM_BETA_1) * (gradient - first)
        second += (1.0 - ADAM_BETA_2) * (gradient * gradient - second)
        unbiased = first / (1.0 - ADAM_BETA_1**turn)
        return -unbiased / (np.sqrt(second / (1.0 - ADAM_BETA_2**turn)) + ADAM_EPSILON)
