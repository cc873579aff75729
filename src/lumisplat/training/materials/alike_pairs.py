"""Pairs of Gaussians whose materials should be alike (docs/method/relightable.md#sky)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.constants.materials import CHROMA_WIDTH, EDGE_WIDTH
from lumisplat.math.arrays import Doubles, Rows


@dataclass(frozen=True, slots=True, eq=False)
class AlikePairs:
    """P pairs, each of two rows."""

    first: Rows
    """Shape (P,)."""
    second: Rows

    def albedo_term(self, log_albedo: Doubles) -> tuple[float, Doubles]:
        """How much albedos differ, and the derivatives by their logarithms, shape (N, 3).

        A difference of a pair counts as ``w^2 log(1 + (d / w)^2) / 2``, so that edges of textures count little, and
        less the more the two differ in chromaticity; that weight is held as it is.
        """
        difference = log_albedo[self.first] - log_albedo[self.second]
        chroma = difference - difference.mean(axis=1, keepdims=True)
        alike = np.exp(-0.5 * np.square(np.abs(chroma).max(axis=1, keepdims=True) / CHROMA_WIDTH))
        ratio = np.square(difference / EDGE_WIDTH)
        share = 1.0 / max(len(self.first), 1)
        term = float((alike * np.log1p(ratio)).sum() * 0.5 * EDGE_WIDTH**2 * share)
        return term, self._scattered(alike * difference / (1.0 + ratio) * share, len(log_albedo))

    def square_term(self, values: Doubles) -> tuple[float, Doubles]:
        """Half the mean squared difference of a number, and the derivatives by it, shape (N,)."""
        difference = values[self.first] - values[self.second]
        share = 1.0 / max(len(self.first), 1)
        return 0.5 * share * float(difference @ difference), self._scattered(difference[:, None] * share, len(values))[
            :, 0
        ]

    def _scattered(self, by_difference: Doubles, count: int) -> Doubles:
        """From derivatives by differences to those by what differs."""
        columns = [
            np.bincount(self.first, column, count) - np.bincount(self.second, column, count)
            for column in by_difference.T
        ]
        return np.stack(columns, axis=1).astype(np.float64)
