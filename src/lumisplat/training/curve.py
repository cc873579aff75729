"""How a training went: numbers over steps, and their picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from PIL import Image, ImageDraw

from lumisplat.training.photo_loss import Loss

EVERY = 50
"""Steps that a point of the curve is the mean of."""
SIZE = (960, 480)
MARGIN = 50
DOT = 3
"""Radius of a point of what was held out, pixels."""
_TRAINING, _HELD_OUT, _LINES = (70, 120, 200), (210, 120, 30), (225, 225, 225)


@dataclass(slots=True)
class Curve:
    """PSNR of the photographs that were learnt from, and of what was held out."""

    steps: list[int] = field(default_factory=list[int])
    """Last step of each point."""
    squared: list[float] = field(default_factory=list[float])
    """Mean squared error over the steps of each point."""
    measured: list[tuple[int, float]] = field(default_factory=list[tuple[int, float]])
    """Step and PSNR of what was held out, dB."""
    _sum: float = 0.0
    _count: int = 0

    @classmethod
    def of(cls, told: dict[str, Any]) -> Curve:
        """Returns the curve that `told` has kept.

        Raises:
            ValueError: Steps or errors are none that a training can have.
        """
        measured = [(int(step), float(value)) for step, value in told["measured"]]
        steps, squared = [int(step) for step in told["steps"]], [float(value) for value in told["squared"]]
        curve = cls(steps, squared, measured, float(told["sum"]), int(told["count"]))
        ascending = all(a < b for a, b in pairwise([0, *steps]))
        sound = all(0.0 <= error < math.inf for error in (*squared, curve._sum))
        sound &= all(step > 0 and not math.isnan(value) for step, value in measured)
        if len(steps) != len(squared) or not ascending or curve._count < 0 or not sound:
            raise ValueError("no curve of a training")
        return curve

    @property
    def told(self) -> dict[str, Any]:
        """All of it, as JSON has it, to the bit; ``sum`` and ``count`` are of the steps since the last point."""
        points = {"steps": self.steps, "squared": self.squared, "measured": self.measured}
        return points | {"sum": self._sum, "count": self._count}

    def add(self, step: int, loss: Loss) -> None:
        """Counts a step."""
        self._sum, self._count = self._sum + loss.squared, self._count + 1
        if step % EVERY == 0:
            self.steps.append(step)
            self.squared.append(self._sum / self._count)
            self._sum, self._count = 0.0, 0

    def measure(self, step: int, psnr: float | None) -> None:
        """Notes what was measured, if anything was held out."""
        if psnr is not None:
            self.measured.append((step, psnr))

    @property
    def psnr(self) -> float:
        """Of the last steps, dB."""
        if self._count:
            return decibels(self._sum / self._count)
        return decibels(self.squared[-1]) if self.squared else 0.0

    def picture(self) -> Image.Image:
        """The curve: blue what was learnt from, orange what was held out."""
        image = Image.new("RGB", SIZE, "white")
        draw = ImageDraw.Draw(image)
        learnt = [(float(step), decibels(error)) for step, error in zip(self.steps, self.squared, strict=True)]
        lines = [[point for point in line if math.isfinite(point[1])] for line in (learnt, self.measured)]
        points = [point for line in lines for point in line]
        if not points:
            return image
        axes = _Axes.around(points)
        axes.draw(draw)
        for line, color in zip(lines, (_TRAINING, _HELD_OUT), strict=True):
            draw.line([axes.place(*point) for point in line], fill=color, width=2)
        for x, y in (axes.place(*point) for point in lines[1]):
            draw.ellipse([x - DOT, y - DOT, x + DOT, y + DOT], fill=_HELD_OUT)
        draw.text((MARGIN + 120, 16), "learnt from", fill=_TRAINING)
        draw.text((MARGIN + 210, 16), "held out", fill=_HELD_OUT)
        return image


@dataclass(frozen=True, slots=True)
class _Axes:
    """Steps to the right, PSNR upwards."""

    last: float
    """The last step."""
    low: int
    """PSNR at the bottom, dB."""
    high: int
    """At the top."""

    @classmethod
    def around(cls, points: Sequence[tuple[float, float]]) -> _Axes:
        """That hold all of the points."""
        values = [value for _, value in points]
        return cls(max(step for step, _ in points), math.floor(min(values)), math.ceil(max(values)) + 1)

    def place(self, step: float, value: float) -> tuple[float, float]:
        """The pixel of a point."""
        across, up = step / self.last, (value - self.low) / (self.high - self.low)
        return MARGIN + (SIZE[0] - 2 * MARGIN) * across, SIZE[1] - MARGIN - (SIZE[1] - 2 * MARGIN) * up

    def draw(self, draw: ImageDraw.ImageDraw) -> None:
        """Lines at round numbers, with these numbers, and what they are of."""
        draw.text((8, 16), "PSNR, dB", fill="black")
        for tick in range(self.low, self.high + 1, max((self.high - self.low) // 8, 1)):
            draw.line([self.place(0.0, tick), self.place(self.last, tick)], fill=_LINES)
            draw.text((MARGIN - 8, self.place(0.0, tick)[1]), str(tick), fill="black", anchor="rm")
        for tick in range(0, int(self.last) + 1, round_step(self.last / 8)):
            x, y = self.place(tick, self.low)
            draw.line([(x, y), (x, y + 5)], fill="black")
            draw.text((x, y + 8), f"{tick:,}", fill="black", anchor="mt")
        draw.line([self.place(0.0, self.low), self.place(self.last, self.low)], fill="black")
        draw.text((SIZE[0] / 2, SIZE[1] - 18), "steps", fill="black", anchor="mt")


def round_step(least: float) -> int:
    """The smallest of 1, 2, 5, 10, 20, 50, ... that is not below a number."""
    power = 10 ** max(math.floor(math.log10(max(least, 1.0))), 0)
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= least)


def decibels(squared: float) -> float:
    """PSNR of a mean squared error; infinite of none."""
    return -10.0 * math.log10(squared) if squared > 0.0 else math.inf
