"""How finely a moving view is drawn: fewer Gaussians first, then fewer pixels, until a frame keeps its time."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lumisplat.viewer.thresholds import (
    GAUSSIANS_AT_ONCE,
    LEVEL_FRACTIONS,
    PACE_FORGETS,
    PACE_HEADROOM,
    PACE_HOLD,
    PIXEL_SCALES,
)


@dataclass(frozen=True)
class Step:
    """How finely a frame is drawn."""

    level: int
    """Number of `LEVEL_FRACTIONS`."""
    scale: float
    """One of `PIXEL_SCALES`."""

    @property
    def is_full(self) -> bool:
        """Whether nothing is left out."""
        return self.level == 0 and self.scale == 1.0


_LAST = len(LEVEL_FRACTIONS) - 1

BY_GAUSSIANS = (
    Step(0, 1.0),
    Step(1, 1.0),
    *(Step(1, scale) for scale in PIXEL_SCALES[1:-1]),
    *(Step(level, PIXEL_SCALES[-2]) for level in range(2, _LAST + 1)),
    Step(_LAST, PIXEL_SCALES[-1]),
)
"""Of frames whose time goes with the Gaussians: a quarter of them is three times faster, half the pixels a sixth."""

BY_PIXELS = tuple(Step(0, scale) for scale in PIXEL_SCALES)
"""Of frames whose time goes with the rays, or that follow from those before them."""


def first_step(count: int) -> int:
    """The number of the step of `BY_GAUSSIANS` at which scenes of so many Gaussians begin: the second, as a rule."""
    level = next((n for n in range(1, _LAST) if count * LEVEL_FRACTIONS[n] <= GAUSSIANS_AT_ONCE), _LAST)
    return next(number for number, step in enumerate(BY_GAUSSIANS) if step.level == level)


class Pace:
    """Chooses steps by how long frames have taken.

    Args:
        steps: From the finest to the coarsest.
        first: The number of the first one.
    """

    def __init__(self, steps: tuple[Step, ...] = BY_GAUSSIANS, first: int = 1) -> None:
        self.steps, self._now = steps, first
        self._took: dict[int, float] = {}
        """Milliseconds of each step, lately."""
        self._held = 0

    @property
    def step(self) -> Step:
        """Of the next frame."""
        return self.steps[self._now]

    def took(self, milliseconds: float, budget: float) -> None:
        """Counts a frame of the present step, and chooses the next one.

        Args:
            milliseconds: What the frame has taken.
            budget: What a frame may take.
        """
        known = self._took.get(self._now, milliseconds)
        self._took[self._now] = 0.5 * (known + milliseconds)
        self._held += 1
        excess = min(milliseconds, known) / budget
        if excess > 1.0 and self._now + 1 < len(self.steps):
            self._move(min(self._now + 1 + int(math.log2(excess)), len(self.steps) - 1))
        elif self._now > 0 and self._held >= PACE_HOLD:
            finer = self._took.get(self._now - 1, 2.0 * self._took[self._now])
            if finer < PACE_HEADROOM * budget:
                self._move(self._now - 1)
            else:  # what once was slow may be quick now: another view, or fewer other programs
                self._took[self._now - 1] = PACE_FORGETS * finer

    def _move(self, to: int) -> None:
        self._now, self._held = to, 0
