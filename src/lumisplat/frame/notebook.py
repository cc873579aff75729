"""A frame as notebooks show it: a picture, chosen by its size, and a line of text."""

from __future__ import annotations

import base64
import io
from collections.abc import Collection

from lumisplat.frame.aovs import Image
from lumisplat.io.images.png import to_bytes

NOTEBOOK_PNG_PIXELS_MAX = 2**20
"""Pixels above which notebooks are given JPEGs of opaque frames, because they keep pictures in base64. Measured at
1280 x 720: a PNG of the demo room takes 0.60 bytes a pixel and a JPEG 0.12, of the biker from nearby 0.29 and 0.05."""

MimeBundle = tuple[dict[str, str], dict[str, dict[str, int]]]
"""Representations by MIME type, pictures in base64, and what is known about them."""

_FORMAT_OF = {"image/png": "PNG", "image/jpeg": "JPEG"}
_JPEG_QUALITY = 92


def mime_type(pixels: Image) -> str:
    """PNG for what is small or transparent, which JPEG cannot hold; JPEG for the rest, so that notebooks stay small."""
    height, width, channels = pixels.shape
    return "image/png" if channels == 4 or height * width <= NOTEBOOK_PNG_PIXELS_MAX else "image/jpeg"


def encoded(pixels: Image, mime: str) -> bytes:
    """A file of display-referred pixels, shape (H, W, 3 or 4), 0..1 or bytes."""
    from PIL import Image as Picture

    stream = io.BytesIO()
    # PNG ignores the quality.
    Picture.fromarray(to_bytes(pixels, "a frame")).save(stream, _FORMAT_OF[mime], quality=_JPEG_QUALITY)
    return stream.getvalue()


def mime_bundle(
    pixels: Image, text: str, include: Collection[str] | None, exclude: Collection[str] | None
) -> MimeBundle:
    """A picture of the frame and its text, without what the notebook does not want.

    Args:
        pixels: As for `encoded`.
        text: The line of text.
        include: The MIME types that are wanted; None: all.
        exclude: MIME types that are not wanted; None: none.
    """
    mime = mime_type(pixels)
    wanted = [kind for kind in (mime, "text/plain") if (not include or kind in include) and kind not in (exclude or ())]
    data = {"text/plain": text} if "text/plain" in wanted else {}
    if mime not in wanted:
        return data, {}
    picture = base64.b64encode(encoded(pixels, mime)).decode("ascii")
    return {mime: picture} | data, {mime: {"width": pixels.shape[1], "height": pixels.shape[0]}}
