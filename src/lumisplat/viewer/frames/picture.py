"""From frames to what a page shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.thresholds import DEPTH_STRIDE

Picture = npt.NDArray[np.uint8]

_BEHIND = 32
"""Grey behind transparent frames."""


@dataclass(frozen=True)
class Shown:
    """What a page is to show next."""

    picture: Picture
    """(H, W, 3), sRGB."""
    quality: int
    """Of the JPEG."""
    depth: npt.NDArray[np.float32] | None = None
    """View depth in units of the page, of every `DEPTH_STRIDE`-th pixel; None: of a view that moves."""


def picture_of(frame: ls.Frame, view: str) -> Picture:
    """The bytes of a frame.

    Args:
        frame: The frame.
        view: ``color``, or one of `lumisplat.Frame.VIEWS`.

    Raises:
        ConfigError: The frame was rendered without what the view needs.
    """
    if view != "color":
        return (255.0 * frame.view(view) + 0.5).astype(np.uint8)
    pixels = np.asarray(frame, np.uint8)
    if pixels.shape[2] == 3:
        return pixels
    share = pixels[..., 3:].astype(np.uint16)
    return ((pixels[..., :3] * share + _BEHIND * (255 - share) + 127) // 255).astype(np.uint8)


def page_depth(frame: ls.Frame, page_from_scene: float) -> npt.NDArray[np.float32]:
    """Depth that a page hides its own handles behind."""
    half = DEPTH_STRIDE // 2
    depth = frame.depth_z[half::DEPTH_STRIDE, half::DEPTH_STRIDE] * page_from_scene
    return np.nan_to_num(depth, nan=1e3, posinf=1e3).astype(np.float32)


def split_picture(before: Picture, after: Picture, share: float) -> Picture:
    """Two pictures of one size as one: ``before`` in the left share of the width, and a line between them."""
    column = min(max(round(share * after.shape[1]), 0), after.shape[1] - 1)
    joined = after.copy()
    joined[:, :column] = before[:, :column]
    joined[:, column] = 255
    return joined
