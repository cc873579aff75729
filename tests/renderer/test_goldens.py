"""The demo scene looks as in its stored frames, which were approved by eye."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from support.compare.goldens import CASES, LAYERS, Golden
from support.compare.images import assert_images_alike


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.view)
def test_demo_scene_looks_like_its_approved_golden_images(case: Golden, demo: ls.Scene) -> None:
    """Colour, normal and depth of a view agree with the stored images."""
    now = case.render(demo)
    with np.load(case.path) as stored:
        for layer in LAYERS:
            expected = stored[layer].astype(np.float32)
            seen = np.isfinite(expected)
            assert (seen == np.isfinite(now[layer])).mean() > 0.999, f"{layer}: the outline moved"
            actual = np.where(seen & np.isfinite(now[layer]), now[layer], 0.0)
            # NumPy versions round differently, so that a few Gaussians sampled from the surfaces may move.
            assert_images_alike(
                actual, np.where(seen, expected, 0.0), mean=1 / 255, within=8 / 255, share=0.98, name=layer
            )


def test_golden_image_comparison_fails_for_a_changed_setting(demo: ls.Scene) -> None:
    """A frame with another setting does not pass the comparison."""
    case = CASES[0]
    blurred = Golden(case.view, "", ls.RenderConfig(raster=ls.RasterConfig(dilation=3.0))).render(demo)
    with np.load(case.path) as stored, pytest.raises(AssertionError):
        assert_images_alike(
            blurred["color"], stored["color"].astype(np.float32), mean=1 / 255, within=8 / 255, share=0.98
        )
