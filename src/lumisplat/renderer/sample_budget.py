"""How many samples a frame takes: by their number, the time and the noise, whichever is reached first."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from lumisplat.config import RenderConfig
from lumisplat.constants import NOISE_SAMPLES_MIN

NOISE_CHECKS = 8
"""How often noise is estimated while samples double: a frame has at most an eighth more of them than it needs."""

_log = logging.getLogger("lumisplat")

ALMOST = 0.999
"""Largest fraction of what is not done."""


class SampleBudget:
    """Counts the samples of a frame, and says when it has enough.

    When noise is estimated depends on the number of samples alone, those of resumed frames included: a frame that is
    interrupted ends with as many as one that is not.

    Args:
        config: Says which noise is low enough, and how long samples may take.
        samples: How many are added at most.
        first: How many the frame has already.
        estimate: Estimates the noise of the samples so far; None: nobody asks.
    """

    def __init__(self, config: RenderConfig, samples: int, first: int, estimate: Callable[[], float] | None) -> None:
        self._config, self._samples, self._first, self._estimate = config, samples, first, estimate
        self._started = time.monotonic()
        self.done = first
        """Samples so far."""
        self.noise: float | None = None
        """The last estimate."""
        self.fraction = 0.0
        """About the share of the work that is done, 0..1; 1: the frame has enough samples."""
        self._update()

    def add(self) -> None:
        """Counts a sample."""
        self.done += 1
        self._update()

    @property
    def is_spent(self) -> bool:
        """Whether the frame has enough samples."""
        return self.fraction >= 1.0

    @property
    def label(self) -> str:
        """What is being done, how many samples there are, and how noisy they are."""
        parts = ["tracing", f"{self.done:,} {'sample' if self.done == 1 else 'samples'}"]
        return ", ".join(parts if self.noise is None else [*parts, f"noise {self.noise:.3f}"])

    def close(self) -> None:
        """Estimates the noise of a frame of few samples, roughly, and logs that it is not as low as it should be."""
        is_rough = self.done < NOISE_SAMPLES_MIN
        if self._estimate is not None and is_rough and self.done > 1:
            self.noise = self._estimate()
        wanted = self._config.noise
        if wanted is not None and (is_rough or self.noise is None or self.noise > wanted):
            found = "too few to tell the noise" if is_rough else f"the noise is {self.noise:.3f}"
            _log.warning("%s after %s samples a pixel, where RenderConfig.noise is %g", found, f"{self.done:,}", wanted)

    def _update(self) -> None:
        """Estimates the noise, if its turn has come, and what is left to do."""
        config, added = self._config, self.done - self._first
        shares = [added / self._samples]
        if self._estimate is not None and is_noise_checked(self.done):
            self.noise = self._estimate()
        if config.noise is not None and self.noise is not None:
            # Errors fall with the root of the number of samples.
            is_low = self.noise <= config.noise
            shares += [1.0 if is_low else min((config.noise / self.noise) ** 2, ALMOST)]
        if config.time_limit is not None and added > 0:
            seconds = time.monotonic() - self._started
            would_be_late = seconds * (added + 1) / added > config.time_limit
            shares += [1.0 if would_be_late else seconds / config.time_limit]
        self.fraction = max(shares)


def is_noise_checked(samples: int) -> bool:
    """Whether noise is estimated after so many samples: `NOISE_CHECKS` times while they double."""
    if samples < NOISE_SAMPLES_MIN:
        return False
    return samples % max(1, 2 ** (samples.bit_length() - 1) // NOISE_CHECKS) == 0
