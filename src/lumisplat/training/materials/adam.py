"""Adam (Kingma and Ba 2015) for an array on the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.constants.training import ADAM_BETA_1, ADAM_BETA_2, ADAM_EPSILON
from lumisplat.math.arrays import Doubles


@dataclass(slots=True, eq=False)
class Adam:
    """Moments of an array that moves against derivatives."""

    first: Doubles
    second: Doubles
    steps: int = 0

    @classmethod
    def still(cls, shape: tuple[int, ...]) -> Adam:
        """Of an array that has not moved yet."""
        return cls(np.zeros(shape), np.zeros(shape))

    def step(self, gradient: Doubles, rate: float) -> Doubles:
        """By how much the array moves."""
        self.steps += 1
        self.first += (1.0 - ADAM_BETA_1) * (gradient - self.first)
        self.second += (1.0 - ADAM_BETA_2) * (gradient * gradient - self.second)
        unbiased = self.first / (1.0 - ADAM_BETA_1**self.steps)
        return -rate * unbiased / (np.sqrt(self.second / (1.0 - ADAM_BETA_2**self.steps)) + ADAM_EPSILON)
