"""Tests which settings the quality presets of real-time frames change."""

from __future__ import annotations

from dataclasses import replace

import lumisplat as ls

PREVIEW, HIGH = ls.config.RealtimeQuality.PREVIEW, ls.config.RealtimeQuality.HIGH


def test_balanced_realtime_quality_equals_the_default_settings() -> None:
    """The preset changes no setting."""
    assert ls.RealtimeConfig().of_quality == ls.RealtimeConfig()


def test_realtime_quality_preview_has_cheaper_settings_and_high_has_costlier_ones() -> None:
    """Rays, filter passes and averaged frames differ."""
    low, middle, high = (ls.RealtimeConfig(quality=quality).of_quality for quality in ls.config.RealtimeQuality)
    assert low.light_interval == 2 > middle.light_interval
    assert middle.highlight_rays and not low.highlight_rays
    assert low.filter.passes < middle.filter.passes
    assert low.probes.refreshed < middle.probes.refreshed
    assert low.cache.bounces < middle.cache.bounces < high.cache.bounces
    assert middle.filter.frames < high.filter.frames
    assert middle.probes.refreshed < high.probes.refreshed
    assert low.probes.tile > middle.probes.tile == high.probes.tile
    assert middle.cache.cell_size > high.cache.cell_size
    assert high.antialiasing and middle.antialiasing and not low.antialiasing


def test_given_realtime_settings_override_the_quality_preset() -> None:
    """Presets replace default values only, also after a change of quality."""
    given = ls.RealtimeConfig(
        quality=PREVIEW, probes=ls.config.ProbeConfig(refreshed=0.5), filter=ls.config.FilterConfig(frames=9)
    )
    assert given.of_quality.probes.refreshed == 0.5
    assert (given.of_quality.filter.frames, given.of_quality.filter.passes) == (9, 2)
    other = replace(given, quality=HIGH).of_quality
    assert (other.probes.refreshed, other.probes.tile, other.filter.frames, other.filter.passes) == (0.5, 8, 9, 4)


def test_realtime_frames_without_a_noise_filter_sample_light_in_every_frame() -> None:
    """Otherwise newly visible surfaces would be black in every second frame."""
    for passes, interval in ((0, 1), (1, 1), (3, 2)):
        config = ls.RealtimeConfig(light_interval=2, filter=ls.config.FilterConfig(passes=passes))
        assert config.of_quality.light_interval == interval
