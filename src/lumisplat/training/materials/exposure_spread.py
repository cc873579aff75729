"""By how much the exposure of photographs changes, beside a capture that was made of them."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

import numpy as np

from lumisplat.constants.materials import EXPOSURE_PIXELS, EXPOSURE_RANGE, EXPOSURE_VIEWS
from lumisplat.frame.frame import Frame
from lumisplat.math.color import decode_srgb
from lumisplat.progress import Progress
from lumisplat.renderer.renderer import Renderer
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene
from lumisplat.training.views import Picture, TrainingView

_INSIDE = 0.99
"""Alpha, or weight, from which on a pixel shows nothing else, or counts."""


def exposure_spread(gaussians: Gaussians, views: Sequence[TrainingView], renderer: Renderer, report: Progress) -> float:
    """Standard deviation of how bright photographs are relative to what the capture shows, stops.

    Args:
        gaussians: The capture.
        views: The photographs.
        renderer: Rasterises without light.
        report: Progress.

    Returns:
        0 where fewer than three photographs tell.
    """
    scene, stops = Scene([gaussians]), list[float]()
    # In no order: bracketed exposures come again every few photographs.
    chosen = random.Random(0).sample(views, min(len(views), EXPOSURE_VIEWS))
    for number, view in enumerate(chosen):
        report("comparing exposures", number / len(chosen))
        stops += _stops_beyond(view.read(), renderer.render(scene, view.camera))
    return float(np.std(stops)) if len(stops) >= 3 else 0.0


def _stops_beyond(picture: Picture, frame: Frame) -> list[float]:
    """By how many stops a photograph is brighter: the ratio of medians over pixels that neither end has cut off.

    Returns:
        Nothing where these are few.
    """
    photograph, shown = picture.color.mean(axis=2), frame.color.mean(axis=2)
    inside = frame.alpha > _INSIDE
    for brightness in (photograph, shown):
        inside = inside & (brightness > EXPOSURE_RANGE[0]) & (brightness < EXPOSURE_RANGE[1])
    for share in (picture.weight, picture.alpha):
        if share is not None:
            inside = inside & (share > _INSIDE)
    if inside.sum() < EXPOSURE_PIXELS:
        return []
    medians = [float(np.median(decode_srgb(one[inside]))) for one in (photograph, shown)]
    return [math.log2(medians[0] / medians[1])]
