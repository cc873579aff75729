"""Random numbers of a view: they follow from the seed, the view's number and what they are for, and nothing else."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from lumisplat.config.setting import Span, WholeSpan
from lumisplat.math.arrays import Doubles

_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
"""Multiples of it, less their whole parts, fill 0..1 evenly from the first on."""


class Purpose(IntEnum):
    """What numbers are for: each has its own, so that settings of one change nothing of another."""

    POSE = 0
    OBJECTS = 1
    LIGHTS = 2
    SPLIT = 3


class Draws:
    """Random numbers of one view, for one purpose. They are the same on every machine.

    Args:
        seed: Of the data set.
        view: The view's number.
        purpose: What they are for.
    """

    def __init__(self, seed: int, view: int, purpose: Purpose) -> None:
        # Uniform numbers alone: how NumPy makes others of them may change from version to version.
        words = np.random.SeedSequence([seed, view, int(purpose)])
        self._generator = np.random.Generator(np.random.Philox(words))

    def units(self, *shape: int) -> Doubles:
        """Numbers from 0 to before 1."""
        return self._generator.random(shape)

    def unit(self) -> float:
        """A number from 0 to before 1."""
        return float(self._generator.random())

    def between(self, ends: Span) -> float:
        """A number of a range."""
        return ends[0] + (ends[1] - ends[0]) * self.unit()

    def factor(self, ends: Span) -> float:
        """A number of a range of positive ones, whose logarithm is spread evenly."""
        return math.exp(self.between((math.log(ends[0]), math.log(ends[1]))))

    def whole(self, ends: WholeSpan) -> int:
        """A whole number of a range, both ends included."""
        return ends[0] + self.below(ends[1] - ends[0] + 1)

    def below(self, count: int) -> int:
        """A whole number from 0 to before ``count``."""
        return min(int(self.unit() * count), count - 1)

    def direction(self) -> Doubles:
        """A unit vector, in any direction, shape (3,)."""
        z, angle = 2.0 * self.unit() - 1.0, 2.0 * math.pi * self.unit()
        level = math.sqrt(max(1.0 - z * z, 0.0))
        return np.array([level * math.cos(angle), level * math.sin(angle), z])


def split_of(seed: int, view: int, shares: tuple[float, float, float]) -> str:
    """The part of the data set that a view is in, ``train``, ``val`` or ``test``.

    Any number of views in a row is divided nearly as the shares say (a Kronecker sequence).
    """
    place = (Draws(seed, 0, Purpose.SPLIT).unit() + view * _GOLDEN) % 1.0
    if place < shares[0]:
        return "train"
    return "val" if place < shares[0] + shares[1] else "test"
