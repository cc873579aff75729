"""What a tone mapper has done is undone."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.tone_map import apply_tone_map
from lumisplat.math.tone_map_inverse import remove_tone_map


@pytest.mark.parametrize(
    ("tone_map", "brightest"), [(ls.ToneMap.NONE, 0.99), (ls.ToneMap.NEUTRAL, 6.0), (ls.ToneMap.AGX, 4.0)]
)
def test_light_comes_back(tone_map, brightest):
    """Colours of all hues, from dark to bright, that the display can show."""
    rng = np.random.default_rng(3)
    light = rng.random((2000, 3)) ** 2 * brightest + 0.01
    light *= rng.random((2000, 1)) * 0.9 + 0.1
    shown = apply_tone_map(light, tone_map).astype(np.float64)
    inside = ((shown > 0.02) & (shown < 0.99)).all(axis=1)
    assert inside.mean() > 0.5
    back = remove_tone_map(shown, tone_map)
    # Pictures are float32, curves are flat where they end, and colours mix: errors are of the brightest channel.
    brightest = light.max(axis=1, keepdims=True)
    np.testing.assert_allclose((back / brightest)[inside], (light / brightest)[inside], atol=1e-3)


@pytest.mark.parametrize("tone_map", ls.ToneMap)
def test_ends_of_the_range_stay_finite(tone_map):
    """Black, white and saturated colours are numbers, none of them negative."""
    ends = np.array([[0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 1, 1]], np.float64)
    back = remove_tone_map(ends, tone_map)
    assert np.isfinite(back).all() and (back >= 0.0).all()
