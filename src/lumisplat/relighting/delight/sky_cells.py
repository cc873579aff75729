"""The sky in cells of equal area, finer where it is bright."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.constants.delight import CELL_REACH
from lumisplat.math.arrays import Doubles, Rows
from lumisplat.math.directions import directions_of_square


@dataclass(frozen=True, slots=True, eq=False)
class SkyCells:
    """K squares of the map of all directions (`directions_of_square`), in which areas are solid angles."""

    corners: Doubles
    """The lowest ones, 0..1, shape (K, 2)."""
    sides: Doubles
    """Their lengths, shape (K,)."""

    @staticmethod
    def even(across: int) -> SkyCells:
        """``across`` times ``across`` of one size."""
        v, u = np.divmod(np.arange(across * across), across)
        return SkyCells(np.stack([u, v], axis=1) / across, np.full(across * across, 1.0 / across))

    def __len__(self) -> int:
        return len(self.sides)

    @property
    def solid_angles(self) -> Doubles:
        """In sr, shape (K,)."""
        return 4.0 * np.pi * self.sides**2

    @property
    def directions(self) -> Doubles:
        """Of their centres, unit, shape (K, 3)."""
        return directions_of_square(self.corners + 0.5 * self.sides[:, None])

    @property
    def neighbours(self) -> Rows:
        """Pairs of cells beside each other, shape (S, 2)."""
        radii = np.sqrt(self.solid_angles / np.pi)
        angles = np.arccos(np.clip(self.directions @ self.directions.T, -1.0, 1.0))
        first, second = np.nonzero(np.triu(angles < CELL_REACH * (radii[:, None] + radii), 1))
        return np.stack([first, second], axis=1)

    def of(self, rows: Rows) -> SkyCells:
        """Some of them."""
        return SkyCells(self.corners[rows], self.sides[rows])

    def joined(self, others: SkyCells) -> SkyCells:
        """These, and others after them."""
        return SkyCells(np.concatenate([self.corners, others.corners]), np.concatenate([self.sides, others.sides]))

    def parts(self, across: int) -> SkyCells:
        """Each in ``across`` times ``across``, one after the other."""
        v, u = np.divmod(np.arange(across * across), across)
        within = np.stack([u, v], axis=1)[None] * (self.sides[:, None, None] / across)
        return SkyCells(
            (self.corners[:, None] + within).reshape(-1, 2), np.repeat(self.sides / across, across * across)
        )

    def directions_within(self, cell: int, count: int, rng: np.random.Generator) -> Doubles:
        """Random directions of a cell, even in solid angle, unit, shape (count, 3)."""
        return directions_of_square(self.corners[cell] + self.sides[cell] * rng.random((count, 2)))
