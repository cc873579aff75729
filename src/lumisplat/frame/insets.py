"""Draws insets on the image of a frame: small false-colour views in a row, in its lower right corner."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lumisplat.frame.frame_data import FrameData
from lumisplat.frame.layers import view_picture

INSET_SHARE = 0.22
"""Height and width of an inset as a fraction of the image's, unless the insets then do not fit side by side."""
INSET_GAP_PX = 8
"""Distance between insets, and from the edges of the image, pixels."""
_EDGE = (110, 110, 110)
"""Colour of the line around each inset, sRGB."""


def with_insets(picture: npt.NDArray[np.uint8], frame: FrameData, views: Sequence[str]) -> npt.NDArray[np.uint8]:
    """Returns an image with framed insets in its lower right corner, from left to right in the order of ``views``.

    Args:
        picture: Image of the frame, sRGB, shape (H, W, 3 or 4); its size may differ from the frame's.
        frame: The frame.
        views: Names from ``Frame.VIEWS``.

    Raises:
        ConfigError: There is no view of this name, or the frame was rendered without the layer that the view needs.
    """
    from PIL import Image, ImageOps

    height, width = picture.shape[:2]
    room = (width - INSET_GAP_PX) // max(len(views), 1) - INSET_GAP_PX - 2  # the edge adds a pixel on each side
    columns = max(min(round(INSET_SHARE * width), room), 1)
    rows = max(round(columns * height / width), 1)
    image = Image.fromarray(picture)
    left, top = width - len(views) * (columns + 2 + INSET_GAP_PX), height - rows - 2 - INSET_GAP_PX
    for number, view in enumerate(views):
        inset = Image.fromarray((255.0 * view_picture(frame, view) + 0.5).astype(np.uint8)).resize((columns, rows))
        framed = ImageOps.expand(inset, border=1, fill=_EDGE).convert(image.mode)
        image.paste(framed, (left + number * (columns + 2 + INSET_GAP_PX), top))
    return np.asarray(image)
