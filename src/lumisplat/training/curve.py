"""How a training went: numbers over steps, and their picture."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from PIL import Image, ImageDraw

from lumisplat.training.photo_loss import Loss

EVERY = 50
"""Steps that a point of the curve is the mean of."""
SIZE = (960, 480)
MARGIN = 50
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
        """That of which ``told`` was kept."""
        measured = [(int(step), float(value)) for step, value in told["measured"]]
        steps, squared = [int(step) for step in told["steps"]], [float(value) for value in told["squared"]]
        return cls(steps, squared, measured, float(told["sum"]), int(told["count"]))

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
        lines = ([(float(s), decibels(e)) for s, e in zip(self.steps, self.squared, strict=True)], self.measured)
        values = [value for line in lines for _, value in line if math.isfinite(value)]
        if not values:
            return image
        low, high = math.floor(min(values)), math.ceil(max(values)) + 1
        last = max(step for line in lines for step, _ in line)

        def place(step: float, value: float) -> tuple[float, float]:
            across = (SIZE[0] - 2 * MARGIN) * step / last
            return MARGIN + across, SIZE[1] - MARGIN - (SIZE[1] - 2 * MARGIN) * (value - low) / (high - low)

        for tick in map(float, range(low, high + 1, max((high - low) // 8, 1))):
            draw.line([place(0, tick), place(last, tick)], fill=_LINES)
            draw.text((8, place(0, tick)[1] - 6), f"{tick:.0f} dB", fill="black")
        draw.text((SIZE[0] - 3 * MARGIN, SIZE[1] - MARGIN + 12), f"{last:,.0f} steps", fill="black")
        for line, color in zip(lines, (_TRAINING, _HELD_OUT), strict=True):
            draw.line([place(step, value) for step, value in line if math.isfinite(value)], fill=color, width=2)
        draw.text((MARGIN, 16), "learnt from", fill=_TRAINING)
        draw.text((MARGIN + 90, 16), "held out", fill=_HELD_OUT)
        return image


def decibels(squared: float) -> float:
    """PSNR of a mean squared error; infinite of none."""
    return -10.0 * math.log10(squared) if squared > 0.0 else math.inf
