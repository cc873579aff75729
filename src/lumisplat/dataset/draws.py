"""Random numbers of a view. They depend only on the seed, the view's index and the purpose of the numbers."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from lumisplat.config.setting import Span, WholeSpan
from lumisplat.math.arrays import Doubles

_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
"""Golden ratio conjugate. Its multiples modulo 1 are spread evenly over 0..1, however many there are."""


class Purpose(IntEnum):
    """Purpose of a view's random numbers, such as its pose; part of the seed of `Draws`.

    Each purpose has a separate stream, so that a setting for one purpose does not change the numbers of another.
    """

    POSE = 0
    OBJECTS = 1
    LIGHTS = 2
    SPLIT = 3


class Draws:
    """Random numbers of one view for one purpose, identical on every machine.

    Args:
        seed: Seed of the data set.
        view: Index of the view.
        purpose: Purpose of the numbers.
    """

    def __init__(self, seed: int, view: int, purpose: Purpose) -> None:
        # Only uniform numbers: NumPy may change other distributions from version to version.
        words = np.random.SeedSequence([seed, view, int(purpose)])
        self._generator = np.random.Generator(np.random.Philox(words))

    def units(self, *shape: int) -> Doubles:
        """Returns an array of uniform numbers in [0, 1), with the given shape."""
        return self._generator.random(shape)

    def unit(self) -> float:
        """Returns a uniform number in [0, 1)."""
        return float(self._generator.random())

    def between(self, ends: Span) -> float:
        """Returns a uniform number between the two numbers ``ends``."""
        return ends[0] + (ends[1] - ends[0]) * self.unit()

    def factor(self, ends: Span) -> float:
        """Returns a random factor between the two positive numbers ``ends``, uniform in its logarithm."""
        return math.exp(self.between((math.log(ends[0]), math.log(ends[1]))))

    def whole(self, ends: WholeSpan) -> int:
        """Returns a uniform integer between the two integers ``ends``, which are included."""
        return ends[0] + self.below(ends[1] - ends[0] + 1)

    def below(self, count: int) -> int:
        """Returns a uniform integer from 0 to ``count - 1``."""
        return min(int(self.unit() * count), count - 1)

    def direction(self) -> Doubles:
        """Returns a uniformly distributed unit vector, shape (3,)."""
        z, angle = 2.0 * self.unit() - 1.0, 2.0 * math.pi * self.unit()
        level = math.sqrt(max(1.0 - z * z, 0.0))
        return np.array([level * math.cos(angle), level * math.sin(angle), z])


def split_of(seed: int, view: int, shares: tuple[float, float, float]) -> str:
    """Returns the split of a view at random: ``train``, ``val`` or ``test``, with the probabilities ``shares``.

    The golden ratio sequence spreads the splits evenly: any run of consecutive views has nearly the given fractions.

    Args:
        seed: Seed of the data set.
        view: Index of the view.
        shares: Fractions of the views in ``train``, ``val`` and ``test``.
    """
    fraction = (Draws(seed, 0, Purpose.SPLIT).unit() + view * _GOLDEN) % 1.0
    if fraction < shares[0]:
        return "train"
    return "val" if fraction < shares[0] + shares[1] else "test"
