"""Images that a film begins with, where samples are added to some that there are."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.frame.frame import Frame
from lumisplat.frame.sample_part import SamplePart


def images_of_frame(frame: Frame) -> dict[str, npt.NDArray[Any]]:
    """The images of a frame that is resumed, by the names of buffers."""
    images = {
        "color": frame.color if frame.captured is None else frame.captured,
        "alpha": frame.alpha,
        "depth": frame.depth,
        "normal": frame.normal,
        "gaussian": frame.gaussian_index,
        "instance": frame.instance_index,
    }
    if frame.light is not None and frame.captured_weight is not None:
        images |= {"captured_weight": frame.captured_weight, "light": frame.light, "lit_color": frame.color}
    return images


def images_of_part(part: SamplePart) -> dict[str, npt.NDArray[Any]]:
    """Those of a part: the surfaces of its first sample; its sums make the others."""
    width, height = part.size
    empty = np.zeros((height, width), np.float32)
    dark = np.zeros((height, width, 3), np.float32)
    lit = {"captured_weight": empty, "light": dark, "lit_color": dark}
    return {"color": dark, "alpha": empty, **part.surfaces, **lit}
