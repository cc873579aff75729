"""Decides how many samples a frame takes: up to a count, a time limit or a noise level, whichever is reached first."""

from __future__ import annotations

import time
from collections.abc import Callable

from lumisplat.config import RenderConfig
from lumisplat.constants import NOISE_SAMPLES_MIN

NOISE_CHECKS = 8
"""Number of noise estimates while the number of samples doubles. A frame takes at most an eighth more samples than its
noise level needs."""

UNFINISHED_FRACTION_MAX = 0.999
"""Largest fraction of the work that counts as done while the noise exceeds its target."""


class SampleBudget:
    """Counts the samples of a frame, and decides when the frame has enough.

    Noise is estimated at fixed numbers of samples, including the samples of a resumed frame. An interrupted and resumed
    frame therefore ends with as many samples as an uninterrupted one.

    Args:
        config: Settings with the noise level and the time limit.
        samples: Largest number of samples to add.
        first: Number of samples that the frame already has.
        estimate: Estimates the noise of the samples so far; None: noise is not needed.
    """

    def __init__(self, config: RenderConfig, samples: int, first: int, estimate: Callable[[], float] | None) -> None:
        self._config, self._samples, self._first, self._estimate = config, samples, first, estimate
        self._started = time.monotonic()
        self.done = first
        """Number of samples that the frame has so far, including samples of a resumed frame."""
        self.noise: float | None = None
        """Last estimate of the relative error of the pixels; None: not estimated yet."""
        self.fraction = 0.0
        """Estimated fraction of the work that is done, 0..1; at 1 the frame has enough samples."""
        self._update()

    def add(self) -> None:
        """Counts a sample."""
        self.done += 1
        self._update()

    @property
    def is_spent(self) -> bool:
        """True if the frame has enough samples."""
        return self.fraction >= 1.0

    @property
    def label(self) -> str:
        """Progress label with the number of samples and, if estimated, the noise."""
        parts = ["tracing", f"{self.done:,} {'sample' if self.done == 1 else 'samples'}"]
        return ", ".join(parts if self.noise is None else [*parts, f"noise {self.noise:.3f}"])

    def close(self) -> str | None:
        """Makes a rough noise estimate if there are few samples; returns a warning if it exceeds the noise level."""
        is_rough = self.done < NOISE_SAMPLES_MIN
        if self._estimate is not None and is_rough and self.done > 1:
            self.noise = self._estimate()
        wanted = self._config.noise
        if wanted is not None and (is_rough or self.noise is None or self.noise > wanted):
            found = "too few samples to estimate the noise" if is_rough else f"the noise is {self.noise:.3f}"
            return (
                f"{found} after {self.done:,} samples a pixel, where RenderConfig.noise is {wanted:g}: allow more "
                "samples or time"
            )
        return None

    def _update(self) -> None:
        """Estimates the noise if an estimate is due at this number of samples, and updates ``fraction``."""
        config, added = self._config, self.done - self._first
        fractions = [added / self._samples]
        if self._estimate is not None and is_noise_checked(self.done):
            self.noise = self._estimate()
        if config.noise is not None and self.noise is not None:
            # The error falls with the square root of the number of samples.
            is_low = self.noise <= config.noise
            fractions += [1.0 if is_low else min((config.noise / self.noise) ** 2, UNFINISHED_FRACTION_MAX)]
        if config.time_limit is not None and added > 0:
            seconds = time.monotonic() - self._started
            would_be_late = seconds * (added + 1) / added > config.time_limit
            fractions += [1.0 if would_be_late else seconds / config.time_limit]
        self.fraction = max(fractions)


def is_noise_checked(samples: int) -> bool:
    """Returns whether noise is estimated after this number of samples: `NOISE_CHECKS` times in each doubling."""
    if samples < NOISE_SAMPLES_MIN:
        return False
    return samples % max(1, 2 ** (samples.bit_length() - 1) // NOISE_CHECKS) == 0
