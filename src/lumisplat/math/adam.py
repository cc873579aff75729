"""The Adam optimiser (Kingma and Ba 2015) for host arrays; Gaussians use the kernel `optimizer_kernels.update`."""

from __future__ import annotations

from dataclasses import dataclass
from types import EllipsisType

import numpy as np

from lumisplat.constants import ADAM_BETA_1, ADAM_BETA_2, ADAM_EPSILON
from lumisplat.math.arrays import Doubles


@dataclass(frozen=True, slots=True, eq=False)
class Adam:
    """Adam's moments of one array. The array is updated as a whole, or row by row with a step count for each row."""

    first: Doubles
    """First moments (means of gradients), in the shape of the array."""
    second: Doubles
    """Second moments (means of squared gradients), in the shape of the array."""
    steps: Doubles
    """Number of updates so far: one count for the array, shape (), or one for each of its K rows, shape (K,)."""

    @classmethod
    def still(cls, shape: tuple[int, ...], *, by_rows: bool = False) -> Adam:
        """Returns moments of 0 and no steps, for an array that was never updated.

        Args:
            shape: Shape of the array.
            by_rows: Whether rows are updated one by one.
        """
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(shape[:1] if by_rows else ()))

    def state(self, name: str) -> dict[str, Doubles]:
        """Returns the moments and step counts as arrays by name, for saving; each name begins with ``name``."""
        return {f"{name}.first": self.first, f"{name}.second": self.second, f"{name}.turns": self.steps}

    def step(self, gradient: Doubles, rate: float = 1.0, row: int | EllipsisType = ...) -> Doubles:
        """Updates the moments, and returns the change to add to the array or to one of its rows.

        Args:
            gradient: Gradient of the loss, in the shape of the array or the row.
            rate: Learning rate.
            row: Row to update; the whole array if not given.
        """
        self.steps[row] += 1.0
        first, second, steps = self.first[row], self.second[row], float(self.steps[row])
        first += (1.0 - ADAM_BETA_1) * (gradient - first)
        second += (1.0 - ADAM_BETA_2) * (gradient * gradient - second)
        unbiased = first / (1.0 - ADAM_BETA_1**steps)
        return -rate * unbiased / (np.sqrt(second / (1.0 - ADAM_BETA_2**steps)) + ADAM_EPSILON)
