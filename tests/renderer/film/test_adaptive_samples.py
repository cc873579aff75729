"""Frames that end at a noise level or time limit, and adaptive sampling of pixels."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import NOISE_SAMPLES_MIN, SAMPLE_RATES
from lumisplat.renderer.film.adaptive_rays import SAMPLE_RATE_MIN, rates_of
from support.compare.backends import BACKENDS, renderer_of
from support.scenes.lit_scene import ENVIRONMENT, LIGHTS, camera, config, scene
from support.scenes.raster_scenes import front_camera, one_gaussian

LAYERS = ("variance", "sample_count", "albedo")
PATHS = config(ls.Pipeline.PATH, samples=40, max_bounces=4, adaptive=True, aovs=LAYERS)
IMAGES = ("color", "alpha", "captured", "captured_weight", "light", "depth", *LAYERS)


def view() -> ls.Camera:
    """Returns the camera of a small frame."""
    return camera().scaled(30, 20)


def lit_room() -> ls.Scene:
    """Returns meshes, Gaussians, mirrors and glass under lights and an environment."""
    return scene(*LIGHTS, ENVIRONMENT)


@functools.cache
def adaptive() -> ls.Frame:
    """Returns an adaptive frame of the path tracer."""
    return ls.render(lit_room(), view(), PATHS, device="cpu")


def image(frame: ls.Frame, name: str) -> np.ndarray:
    """Returns the image of the frame with the given name, which must exist."""
    assert getattr(frame, name) is not None
    return getattr(frame, name)


def assert_equal(found: ls.Frame, expected: ls.Frame) -> None:
    """Checks that all images of two frames have the same bits."""
    for name in IMAGES:
        np.testing.assert_array_equal(image(found, name), image(expected, name), name)


def test_adaptively_sampled_pixel_equals_that_of_a_frame_with_its_sample_count() -> None:
    """The bits are equal, because samples, sub-pixel positions and low-discrepancy points are numbered without gaps."""
    found, counts = adaptive(), image(adaptive(), "sample_count")
    assert counts.min() == 16 + 24 * SAMPLE_RATE_MIN // SAMPLE_RATES and counts.max() == 40
    assert len(np.unique(counts)) > 8
    plain = replace(PATHS, adaptive=False)
    more = ls.create_renderer(replace(plain, samples=1), "cpu")
    frame = ls.render(lit_room(), view(), replace(plain, samples=18), device="cpu")
    for count in range(19, 41):
        frame = more.render(lit_room(), view(), resume=frame)
        chosen = counts == count
        for name in ("color", "alpha", *LAYERS):
            np.testing.assert_array_equal(image(found, name)[chosen], image(frame, name)[chosen], name)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_adaptive_frames_do_not_depend_on_interruptions_or_thread_count(threads: int) -> None:
    """Frames are interrupted before, at and after the sample that sets the sampling rates, and while pixels pause."""
    frame = None
    renderers = {n: ls.create_renderer(replace(PATHS, samples=n), "cpu", threads=threads) for n in (1, 7, 9, 11)}
    for n in (7, 9, 1, 1, 11, 11):
        frame = renderers[n].render(lit_room(), view(), resume=frame)
    assert frame is not None and frame.samples == 40
    assert_equal(frame, adaptive())


@pytest.mark.parametrize("schedule", BACKENDS[1:])
def test_adaptive_sample_counts_of_the_cpu_and_cuda_schedules_are_almost_equal(schedule: str) -> None:
    """CUDA's schedule runs on the CPU, with and without graphs; rounding may change a few counts."""
    frame = renderer_of(schedule, PATHS).render(lit_room(), view())
    counts = image(frame, "sample_count"), image(adaptive(), "sample_count")
    assert np.mean(counts[0] != counts[1]) < 0.02, "rounding may change a rate by one step"
    assert abs(frame.color.mean() / adaptive().color.mean() - 1.0) < 1e-3
    assert frame.stats is not None and frame.stats.nonfinite_count == 0


def test_interrupted_frame_with_a_noise_target_takes_as_many_samples_as_an_uninterrupted_one() -> None:
    """The frame ends at the same sample, however often it was interrupted; a finished frame gets no more samples."""
    settings = replace(PATHS, samples=None, noise=0.15, adaptive=None)
    whole = ls.render(lit_room(), view(), settings, device="cpu")
    assert whole.stats is not None and whole.stats.noise is not None
    assert 0.1 < whole.stats.noise <= 0.15 and whole.samples > NOISE_SAMPLES_MIN
    parts = ls.create_renderer(replace(settings, samples=13), "cpu")
    frame = parts.render(lit_room(), view())
    while frame.samples < whole.samples:
        frame = parts.render(lit_room(), view(), resume=frame)
    assert_equal(frame, whole)
    assert_equal(parts.render(lit_room(), view(), resume=frame), whole)
    errors = np.sqrt(image(whole, "variance") @ np.array([0.2126, 0.7152, 0.0722]))
    luminance = np.maximum(whole.color @ np.array([0.2126, 0.7152, 0.0722]), 0.01)
    assert np.mean(errors / luminance <= whole.stats.noise) == pytest.approx(0.95, abs=0.01)


def test_frame_with_a_time_limit_renders_at_least_one_sample_and_stops() -> None:
    """A resumed frame equals a frame with the same number of samples."""
    settings = replace(PATHS, samples=None, adaptive=None, aovs=LAYERS)
    short = ls.create_renderer(replace(settings, time_limit=1e-6), "cpu")
    frame = short.render(lit_room(), view(), resume=short.render(lit_room(), view()))
    assert frame.samples == 2
    frame = ls.create_renderer(replace(settings, time_limit=0.2), "cpu").render(lit_room(), view(), resume=frame)
    assert frame.samples > 2 and frame.stats is not None
    assert_equal(frame, ls.render(lit_room(), view(), replace(settings, samples=frame.samples), device="cpu"))
    few = ls.render(lit_room(), view(), replace(settings, time_limit=1e3, samples=3), device="cpu")
    assert few.samples == 3


def veil() -> tuple[ls.Scene, ls.Camera, ls.RenderConfig]:
    """Returns a white Gaussian: each sample of a pixel is white with the probability of its alpha, else black."""
    hit = ls.TraceConfig(strategy=ls.config.TraceStrategy.STOCHASTIC_HIT)
    settings = ls.RenderConfig(
        pipeline=ls.Pipeline.TRACE, trace=hit, lighting=False, jitter=False, samples=1, aovs=("sample_count",)
    )
    return ls.Scene([one_gaussian(scale=0.7, opacity=0.6, color=(1, 1, 1))]), front_camera(80, 60, 60.0), settings


def score(means: np.ndarray, counts: np.ndarray, truth: np.ndarray) -> float:
    """Returns the error of the sum of pixel means, in standard errors."""
    return float((means - truth).sum() / np.sqrt((truth * (1.0 - truth) / counts).sum()))


def test_adaptive_sampling_does_not_bias_the_mean_brightness() -> None:
    """Rare samples are bright, so that a rule that stops each pixel by its samples' error would darken the frame."""
    gaussian, camera, settings = veil()
    steady = replace(settings, trace=ls.TraceConfig(), aovs=())
    truth = ls.render(gaussian, camera, steady, device="cpu").alpha.astype(np.float64)
    frames = [
        ls.render(gaussian, camera, replace(settings, samples=96, adaptive=True, seed=seed), device="cpu")
        for seed in range(8)
    ]
    scores = [score(frame.alpha.astype(np.float64), image(frame, "sample_count"), truth) for frame in frames]
    assert np.ptp(image(frames[0], "sample_count")) == 70
    assert np.abs(scores).max() < 4.0 and abs(np.sum(scores)) < 4.0 * np.sqrt(len(scores))

    draws = np.random.default_rng(8).random((96, *truth.shape)) < truth
    counts = naive_counts(draws)
    means = np.take_along_axis(np.cumsum(draws, axis=0), counts[None] - 1, axis=0)[0] / counts
    assert score(means, counts, truth) < -6.0, "the test must detect the bias of naive stopping"


def naive_counts(draws: np.ndarray) -> np.ndarray:
    """Returns sample counts of pixels that stop, after 16 samples, once their relative error is below 20 %."""
    numbers = np.arange(1, len(draws) + 1)[:, None, None]
    means = np.cumsum(draws, axis=0) / numbers
    errors = np.sqrt(means * (1.0 - means) / (numbers - 1).clip(1)) / np.maximum(means, 0.1)
    is_done = (errors < 0.2) & (numbers >= NOISE_SAMPLES_MIN)
    return np.where(is_done.any(axis=0), is_done.argmax(axis=0) + 1, len(draws))


def test_adaptive_sampling_rate_of_a_pixel_rises_with_its_noise() -> None:
    """The rate rises in steps from 1/8 for quiet pixels to 1 for the noisiest; frames without noise have rate 1."""
    noise = np.linspace(0.0, 1.0, 1001, dtype=np.float32)
    rates = rates_of(noise)
    assert (np.diff(rates) >= 0).all() and set(rates) == set(range(SAMPLE_RATE_MIN, SAMPLE_RATES + 1))
    assert (rates[950:] == SAMPLE_RATES).all() and rates[474] == SAMPLE_RATES // 2
    assert (rates_of(np.zeros(9, np.float32)) == SAMPLE_RATES).all()


def test_path_tracer_drops_and_counts_non_finite_samples() -> None:
    """The path tracer counts dropped samples and averages the others, with fixed and with adaptive sample counts."""
    _, camera, settings = veil()
    broken = replace(one_gaussian(scale=0.7, opacity=0.6), sh=np.full((1, 16, 3), 3e38, np.float32))
    for changes in ({"samples": 40}, {"samples": 40, "adaptive": True}):
        for base in (settings, replace(settings, pipeline=ls.Pipeline.PATH, lighting=True)):
            frame = ls.render(ls.Scene([broken]), camera, replace(base, **changes), device="cpu")
            counts = image(frame, "sample_count")
            assert frame.stats is not None and frame.stats.nonfinite_count > 1000
            assert np.isfinite(frame.color).all()
            assert not frame.alpha.any(), "the remaining samples are misses"
            if "adaptive" not in changes:
                assert frame.stats.nonfinite_count == (40 - counts).sum()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"time_limit": 0}, r"^time_limit is 0, expected a number above 0 \(seconds\)$"),
        ({"time_limit": -1.5}, r"^time_limit is -1\.5, expected a number above 0 \(seconds\)$"),
        ({"time_limit": float("inf")}, r"^time_limit is inf"),
        ({"time_limit": "1"}, r"^time_limit is '1'"),
        ({"noise": 0.0}, r"^noise is 0\.0, expected more than 0 and less than 1$"),
        ({"noise": 1}, r"^noise is 1, expected more than 0"),
        ({"noise": float("nan")}, r"^noise is nan"),
        ({"adaptive": "yes"}, r"^adaptive is 'yes', expected True or False$"),
    ],
)
def test_error_for_an_invalid_noise_target_or_time_limit_states_its_range(
    changes: dict[str, Any], message: str
) -> None:
    """The error names the setting and its valid range."""
    with pytest.raises(ls.ConfigError, match=message):
        ls.RenderConfig(**changes)


def test_adaptive_sampling_of_rasterised_frames_is_refused() -> None:
    """Shared random numbers are refused, too; by default, rasterised frames sample all pixels equally."""
    gaussian, camera, settings = veil()
    shared = ls.ShadowConfig(method=ls.config.ShadowMethod.STOCHASTIC, shared_draws=True)
    for changes, message in (
        ({"pipeline": ls.Pipeline.HYBRID, "lighting": True}, r"needs traced camera rays: use Pipeline\.PATH"),
        ({"shadow_rays": shared}, "independent random numbers per pixel"),
    ):
        with pytest.raises(ls.ConfigError, match=message):
            ls.render(gaussian, camera, replace(settings, **changes, adaptive=True), device="cpu")
        frame = ls.render(gaussian, camera, replace(settings, **changes, noise=0.9, samples=18), device="cpu")
        assert np.ptp(image(frame, "sample_count")) == 0
    with pytest.raises(ls.ConfigError, match="aovs has variance, which needs two samples or more"):
        ls.render(gaussian, camera, replace(settings, aovs="variance"), device="cpu")


@pytest.mark.parametrize(
    ("changes", "names"),
    [({"noise": 0.1}, "noise"), ({"adaptive": False}, "adaptive"), ({"aovs": ("albedo",)}, "aovs")],
)
def test_resuming_an_adaptive_frame_with_another_noise_target_or_layers_is_refused(
    changes: dict[str, Any], names: str
) -> None:
    """A frame with another noise target or with other layers is refused in one line."""
    renderer = ls.create_renderer(replace(PATHS, **changes), "cpu")
    with pytest.raises(ls.ConfigError, match=rf"other settings: they differ in {names}$"):
        renderer.render(lit_room(), view(), resume=adaptive())
    with pytest.raises(
        ls.ConfigError,
        match=r"lacks accumulated images: albedo, count, rates, sums; render it again with these settings$",
    ):
        ls.create_renderer(PATHS, "cpu").render(lit_room(), view(), resume=replace(adaptive(), accumulated=None))
    with pytest.raises(ls.ConfigError, match=r"lacks accumulated images: sums; render it again with these settings$"):
        held = {name: words for name, words in (adaptive().accumulated or {}).items() if name != "sums"}
        ls.create_renderer(PATHS, "cpu").render(lit_room(), view(), resume=replace(adaptive(), accumulated=held))
