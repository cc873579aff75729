"""Adam (Kingma and Ba 2015) for arrays on the host; the one for Gaussians is a kernel, `optimizer_kernels.update`."""

from __future__ import annotations

from dataclasses import dataclass
from types import EllipsisType

import numpy as np

from lumisplat.constants import ADAM_BETA_1, ADAM_BETA_2, ADAM_EPSILON
from lumisplat.math.arrays import Doubles


@dataclass(frozen=True, slots=True, eq=False)
class Adam:
    """Moments of an array that moves as a whole, or row by row, each row with a count of steps of its own."""

    first: Doubles
    """The shape of the array."""
    second: Doubles
    """The shape of the array."""
    steps: Doubles
    """How often the array has moved, shape (), or each row, shape (K,)."""

    @classmethod
    def still(cls, shape: tuple[int, ...], *, by_rows: bool = False) -> Adam:
        """Returns the moments of an array that has not moved yet.

        Args:
            shape: Of the array.
            by_rows: Whether its rows move one by one.
        """
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(shape[:1] if by_rows else ()))

    def state(self, name: str) -> dict[str, Doubles]:
        """Returns the moments and the counts, by names that begin with ``name``."""
        return {f"{name}.first": self.first, f"{name}.second": self.second, f"{name}.turns": self.steps}

    def step(self, gradient: Doubles, rate: float = 1.0, row: int | EllipsisType = ...) -> Doubles:
        """Updates the moments, and returns by how much the array, or a row of it, moves.

        Args:
            gradient: Derivatives of the loss, the shape of the array or the row.
            rate: Learning rate.
            row: The row that moves; all of the array if not given.
        """
        self.steps[row] += 1.0
        first, second, steps = self.first[row], self.second[row], float(self.steps[row])
        first += (1.0 - ADAM_BETA_1) * (gradient - first)
        second += (1.0 - ADAM_BETA_2) * (gradient * gradient - second)
        unbiased = first / (1.0 - ADAM_BETA_1**steps)
        return -rate * unbiased / (np.sqrt(second / (1.0 - ADAM_BETA_2**steps)) + ADAM_EPSILON)
