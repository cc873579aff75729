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

    @classmethod
    def still(cls, count: int, parameters: int) -> AdamRows:
        """Of parameters that have not moved yet."""
        return cls(np.zeros((count, parameters)), np.zeros((count, parameters)))

    def step(self, number: int, gradient: Doubles, turn: int) -> Doubles:
        """How far the parameters of a photograph move against their derivatives, at a rate of 1.

        Args:
            number: The photograph.
            gradient: Derivatives of the loss, shape (P,).
            turn: How many times its turn has come, with this one.
        """
        first, second = self.first[number], self.second[number]
        first += (1.0 - ADAM_BETA_1) * (gradient - first)
        second += (1.0 - ADAM_BETA_2) * (gradient * gradient - second)
        unbiased = first / (1.0 - ADAM_BETA_1**turn)
        return -unbiased / (np.sqrt(second / (1.0 - ADAM_BETA_2**turn)) + ADAM_EPSILON)
