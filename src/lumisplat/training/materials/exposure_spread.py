"""By how much the exposure of photographs changes, beside a capture that was made of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lumisplat.constants.materials import EXPOSURE_PIXELS, EXPOSURE_RANGE, EXPOSURE_VIEWS
from lumisplat.math.arrays import Flags
from lumisplat.math.color import decode_srgb
from lumisplat.progress import Progress
from lumisplat.renderer.renderer import Renderer
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene
from lumisplat.training.views import TrainingView


def exposure_spread(gaussians: Gaussians, views: Sequence[TrainingView], renderer: Renderer, report: Progress) -> float:
    """Standard deviation of the photographs' brightness relative to what the capture shows, stops.

    Of each of some photographs, the median over pixels that neither black nor white has cut off.

    Args:
        gaussians: The capture.
        views: The photographs.
        renderer: Rasterises without light.
        report: Progress.

    Returns:
        0 where fewer than three photographs tell.
    """
    scene, stops = Scene([gaussians]), list[float]()
    chosen = views[:: -(-len(views) // EXPOSURE_VIEWS)]
    for number, view in enumerate(chosen):
        report("comparing exposures", number / len(chosen))
        picture, frame = view.read(), renderer.render(scene, view.camera)
        both = np.stack([picture.color.mean(axis=2), frame.color.mean(axis=2)])
        told: Flags = ((both > EXPOSURE_RANGE[0]) & (both < EXPOSURE_RANGE[1])).all(axis=0)
        inside: Flags = told & (frame.alpha > 0.99)
        for share in (picture.weight, picture.alpha):
            if share is not None:
                inside &= share > 0.99
        if inside.sum() >= EXPOSURE_PIXELS:
            photograph, shown = (float(np.median(decode_srgb(one[inside]))) for one in both)
            stops.append(math.log2(photograph / shown))
    return float(np.std(stops)) if len(stops) >= 3 else 0.0
