"""Comparison with Mitsuba: the stored images of tools/make_mitsuba_reference.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.compare.images import assert_images_alike
from support.scenes.raster_scenes import mitsuba_frames

REFERENCE = Path(__file__).resolve().parents[2] / "reference"


@pytest.mark.parametrize("name", mitsuba_frames())
@pytest.mark.parametrize(
    ("hit_distance", "alike"), [(ls.config.HitDistance.HULL, True), (ls.config.HitDistance.PEAK, False)]
)
def test_traced_frame_equals_mitsuba_if_hits_are_sorted_by_hulls_and_differs_if_by_peaks(
    name: str, hit_distance: ls.config.HitDistance, alike: bool
) -> None:
    """Ordered by hulls as in Mitsuba, 99.5 % are within four 8-bit steps, half a step in the mean; by peaks, not."""
    with np.load(REFERENCE / f"mitsuba_{name}.npz") as stored:
        image = stored["image"] / float(stored["steps"])
    gaussians, camera = mitsuba_frames()[name]
    trace = ls.TraceConfig(hit_distance=hit_distance, transmittance_min=0.01, dilation=0.0)
    response = ls.config.ResponseConfig(min_response=0.01)
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, trace=trace, response=response, samples=64)
    frame = ls.render(ls.Scene([gaussians]), camera, config, device="cpu")
    assert image.max() > 0.5
    if alike:
        assert_images_alike(frame.color, image, mean=0.5 / 255.0, within=4.0 / 255.0, share=0.995)
    else:
        with pytest.raises(AssertionError):
            assert_images_alike(frame.color, image, mean=0.5 / 255.0, within=4.0 / 255.0, share=0.995)
