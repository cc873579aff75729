"""Encodes images for files and notebooks: depth as 16-bit grey with its range as metadata, frames as PNG or JPEG."""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Collection

import numpy as np

from lumisplat.frame.layers import Image
from lumisplat.io.images.texture import to_bytes, write_gray_png
from lumisplat.math.arrays import FloatArray

NOTEBOOK_PNG_PIXELS_MAX = 2**20
"""Largest number of pixels of a frame that a notebook stores as PNG; a larger opaque frame becomes a JPEG, because
notebooks store images in base64. At 1280 x 720, the demo room takes 0.60 bytes a pixel as PNG and 0.12 as JPEG."""

MimeBundle = tuple[dict[str, str], dict[str, dict[str, int]]]
"""An object's representations by MIME type (images in base64), and the metadata of each representation."""

_FORMAT_OF = {"image/png": "PNG", "image/jpeg": "JPEG"}
_JPEG_QUALITY = 92


def mime_type(pixels: Image) -> str:
    """Returns the MIME type for an image in a notebook: PNG if it is small or has alpha, else the smaller JPEG."""
    height, width, channels = pixels.shape
    return "image/png" if channels == 4 or height * width <= NOTEBOOK_PNG_PIXELS_MAX else "image/jpeg"


def encoded(pixels: Image, mime: str) -> bytes:
    """Encodes a display-referred image, shape (H, W, 3 or 4), floats 0..1 or bytes, as a PNG or JPEG file in memory."""
    from PIL import Image as Picture

    stream = io.BytesIO()
    # PNG ignores the quality.
    Picture.fromarray(to_bytes(pixels, "a frame")).save(stream, _FORMAT_OF[mime], quality=_JPEG_QUALITY)
    return stream.getvalue()


def mime_bundle(
    pixels: Image, text: str, include: Collection[str] | None, exclude: Collection[str] | None
) -> MimeBundle:
    """Returns a notebook's representations of a frame: an image and a line of text, in the requested MIME types.

    Args:
        pixels: The image, as for `encoded`.
        text: The line of text.
        include: MIME types that the notebook requests; None: all.
        exclude: MIME types that the notebook refuses; None: none.
    """
    mime = mime_type(pixels)
    kinds = [kind for kind in (mime, "text/plain") if (not include or kind in include) and kind not in (exclude or ())]
    data = {"text/plain": text} if "text/plain" in kinds else {}
    if mime not in kinds:
        return data, {}
    picture = base64.b64encode(encoded(pixels, mime)).decode("ascii")
    return {mime: picture} | data, {mime: {"width": pixels.shape[1], "height": pixels.shape[0]}}


_STEPS = 65534
"""Number of steps of 16-bit grey between the nearest surface (value 1) and the farthest (65535); 0 means "no surface".
"""
_FORMULA = "depth = depth_near + (value - 1) / 65534 * (depth_far - depth_near); value 0: no surface"


def depth_range(depth: FloatArray) -> tuple[float, float] | None:
    """Returns the nearest and the farthest finite depth, scene units; None if no pixel has a surface."""
    surface = depth[np.isfinite(depth)]
    return (float(surface.min()), float(surface.max())) if surface.size else None


def write_depth_png(path: str | os.PathLike[str], depth: FloatArray) -> None:
    """Writes depths as a 16-bit grey PNG: linear from 1 (nearest surface) to 65535 (farthest), 0 without a surface.

    The PNG's text chunks ``depth_near``, ``depth_far`` (scene units, along the ray) and ``depth_formula`` say how to
    decode the values.

    Args:
        path: PNG file. The file appears complete or not at all.
        depth: Distances along the rays, scene units, shape (H, W); not finite without a surface.

    Raises:
        FormatError: The file cannot be written.
    """
    near, far = depth_range(depth) or (0.0, 0.0)
    hit = np.isfinite(depth)
    share = (np.where(hit, depth, near).astype(np.float64) - near) / max(far - near, np.finfo(np.float32).tiny)
    values = np.where(hit, 1.0 + np.rint(_STEPS * share), 0.0).astype(np.uint16)
    write_gray_png(path, values, {"depth_near": f"{near!r}", "depth_far": f"{far!r}", "depth_formula": _FORMULA})
