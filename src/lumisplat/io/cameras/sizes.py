"""Sizes of the images of cameras whose files have an aspect ratio, but no size."""

from __future__ import annotations

BOX = (1280, 720)
"""Largest width and height, pixels, of a camera for which no size is given."""


def size_of_aspect(aspect: float, width: int | None, height: int | None) -> tuple[int, int]:
    """Width and height, pixels.

    Args:
        aspect: Width by height.
        width: Width that is wanted; None: from the height and the aspect ratio.
        height: Height that is wanted. If both are None, the largest size within 1280 x 720.
    """
    if width is None and height is None:
        if aspect >= BOX[0] / BOX[1]:
            width = BOX[0]
        else:
            height = BOX[1]
    if width is None:
        assert height is not None
        width = max(1, round(height * aspect))
    return width, max(1, round(width / aspect)) if height is None else height
