"""What is left of a capture: never nothing."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.scene.gaussians import Gaussians


def remaining(gaussians: Gaussians, kept: npt.NDArray[np.bool_]) -> Gaussians:
    """The Gaussians of a mask, shape (N,); the same object if that is all of them.

    Raises:
        SceneError: It is none of them; the message has the capture's bounds.
    """
    if kept.all():
        return gaussians
    if not kept.any():
        low, high = gaussians.bounds()
        bounds = "({:.4g}, {:.4g}, {:.4g}) to ({:.4g}, {:.4g}, {:.4g})".format(*low, *high)
        raise SceneError(f"nothing is left of {gaussians.count:,} Gaussians, whose means lie within {bounds}")
    return gaussians.subset(kept)
