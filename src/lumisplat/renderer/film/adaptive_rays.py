"""Adaptive sampling, which draws more samples for noisy pixels (docs/method/samples.md)."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from lumisplat.constants import NOISE_PIXELS, NOISE_SAMPLES_MIN, SAMPLE_RATES
from lumisplat.device.structs.camera import ListedRays
from lumisplat.math.arrays import FloatArray, IntArray
from lumisplat.math.color import encode_srgb
from lumisplat.math.tone_map import exposure_gain
from lumisplat.renderer.film import adaptive_kernels as kernels
from lumisplat.renderer.trace.camera_rays import ray_count
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array, grown_capacity
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import prefix_sum

SAMPLE_RATE_MIN = 2
"""Lowest sampling rate of a pixel, in units of 1 / `SAMPLE_RATES`. Pixels that seem free of noise still take part in
an eighth of all samples, because the few samples they had may have missed light."""

NOISE_LUMINANCE_MIN = 0.01
"""Noise of pixels below this luminance (linear, after exposure) is measured as an absolute error, of other pixels as a
relative error. At this luminance, an error of 2 % is a third of an 8-bit step in display space."""


class AdaptiveRays:
    """Chooses the sampling rates of pixels, and lists the rays of the pixels that take part in a sample.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._size = (0, 0)

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def begin(self, size: tuple[int, int]) -> None:
        """Starts a frame of ``size`` (width, height).

        Every pixel takes part in every sample until `choose_rates` runs.
        """
        self._size = size
        self.rates.fill_(SAMPLE_RATES)

    @property
    def rates(self) -> DeviceArray:
        """Sampling rate of each pixel: its number of samples among each `SAMPLE_RATES` consecutive samples."""
        return self._buffers.get("film.rates", wp.int32, self._pixel_count)

    @property
    def listed(self) -> ListedRays:
        """Arrays with room for a list of the rays of all pixels."""
        return self._listed(grown_capacity(ray_count(*self._size)))

    def list(self, sample: int, *, jitters: bool) -> ListedRays:
        """Returns the rays of the pixels that take part in a sample; unused entries at the end are -1.

        Args:
            sample: Index of the sample in the frame; pixels with a low sampling rate skip some indices.
            jitters: Whether samples are spread over their pixels; False: all samples have the position of the first.
        """
        count, (width, height) = ray_count(*self._size), self._size
        is_drawn = self._buffers.get("film.is_drawn", wp.int32, count)
        ends = self._buffers.get("film.drawn_ends", wp.int32, count)
        with self._launcher.stage("list"):
            run = self._launcher.run_banded
            run(kernels.mark_rays, count, sample, width, height, self.rates, is_drawn)
            prefix_sum(is_drawn, ends, inclusive=True)
            listed = self._listed(self._launcher.capacity_of(ends))
            device_array(listed.ray).fill_(-1)
            run(kernels.list_rays, count, sample, jitters, width, self.rates, is_drawn, ends, listed)
        return listed

    def choose_rates(self, film: DeviceArray, least: float) -> None:
        """Sets each pixel's sampling rate in proportion to the mean noise of the 7 x 7 pixels around it.

        Args:
            film: The film, with the first `NOISE_SAMPLES_MIN` samples of all pixels.
            least: Luminance below which errors are absolute instead of relative.
        """
        count, get = self._pixel_count, self._buffers.get
        noise, means = get("film.noise", wp.float32, count), get("film.noise_around", wp.float32, count)
        with self._launcher.stage("noise"):
            self._launcher.run_banded(kernels.measure_noise, count, least, film, noise)
            self._launcher.run_banded(kernels.average_neighbors, count, *self._size, noise, means)
            self.rates.assign(rates_of(means.numpy()))

    def total_before(self, sample: int) -> int:
        """Returns how many samples all pixels together have after the frame's first ``sample`` samples."""
        first = min(sample, NOISE_SAMPLES_MIN)
        rates = self.rates.numpy().astype(np.int64)
        return first * len(rates) + int(((sample - first) * rates // SAMPLE_RATES).sum())

    def _listed(self, capacity: int) -> ListedRays:
        return self._buffers.struct("film.listed", ListedRays, capacity)

    @property
    def _pixel_count(self) -> int:
        return self._size[0] * self._size[1]


def rates_of(noise: FloatArray) -> IntArray:
    """Returns each of N pixels' sampling rate, in units of 1 / `SAMPLE_RATES`, in proportion to its noise, (N,).

    Pixels noisier than the quantile `NOISE_PIXELS` take part in all samples.

    Args:
        noise: Relative variance of one sample of each pixel, (N,).
    """
    reference = quantile(noise, NOISE_PIXELS)
    if not reference > 0.0:
        return np.full(len(noise), SAMPLE_RATES, np.int32)
    rates = np.ceil(SAMPLE_RATES * np.minimum(noise / np.float32(reference), 1.0))
    return np.clip(rates, SAMPLE_RATE_MIN, SAMPLE_RATES).astype(np.int32)


def least_luminance(exposure: float, *, is_lit: bool) -> float:
    """Returns the luminance below which a pixel's error is absolute: linear for a lit frame, else sRGB-encoded."""
    if is_lit:
        return NOISE_LUMINANCE_MIN / exposure_gain(exposure)
    return float(encode_srgb(np.float32(NOISE_LUMINANCE_MIN)))


def quantile(values: FloatArray, share: float) -> float:
    """Returns the ``share`` quantile: the smallest value such that this fraction of the values is no larger.

    The result is NaN if there are no values.
    """
    if not values.size:
        return math.nan
    index = math.ceil(share * values.size) - 1
    return float(np.partition(values, index)[index])
