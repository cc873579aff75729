"""Encodes images of a frame: depth as 16-bit grey with its range in the file's metadata, and images for notebooks."""

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
"""Number of pixels above which notebooks get JPEGs of opaque frames, because notebooks store images in base64.
Measured at 1280 x 720, in bytes a pixel: the demo room takes 0.60 as PNG and 0.12 as JPEG, the biker from nearby 0.29
and 0.05."""

MimeBundle = tuple[dict[str, str], dict[str, dict[str, int]]]
"""Representations of an object by MIME type (images in base64), and their metadata."""

_FORMAT_OF = {"image/png": "PNG", "image/jpeg": "JPEG"}
_JPEG_QUALITY = 92


def mime_type(pixels: Image) -> str:
    """Chooses PNG for small or transparent images, JPEG for others, so that notebooks stay small."""
    height, width, channels = pixels.shape
    return "image/png" if channels == 4 or height * width <= NOTEBOOK_PNG_PIXELS_MAX else "image/jpeg"


def encoded(pixels: Image, mime: str) -> bytes:
    """Encodes display-referred pixels, shape (H, W, 3 or 4), 0..1 or bytes, as a PNG or JPEG file."""
    from PIL import Image as Picture

    stream = io.BytesIO()
    # PNG ignores the quality.
    Picture.fromarray(to_bytes(pixels, "a frame")).save(stream, _FORMAT_OF[mime], quality=_JPEG_QUALITY)
    return stream.getvalue()


def mime_bundle(
    pixels: Image, text: str, include: Collection[str] | None, exclude: Collection[str] | None
) -> MimeBundle:
    """Returns an image of the frame and its line of text, restricted to the types that the notebook wants.

    Args:
        pixels: Pixels as for `encoded`.
        text: Line of text.
        include: MIME types that are wanted; None: all.
        exclude: MIME types that are not wanted; None: none.
    """
    mime = mime_type(pixels)
    wanted = [kind for kind in (mime, "text/plain") if (not include or kind in include) and kind not in (exclude or ())]
    data = {"text/plain": text} if "text/plain" in wanted else {}
    if mime not in wanted:
        return data, {}
    picture = base64.b64encode(encoded(pixels, mime)).decode("ascii")
    return {mime: picture} | data, {mime: {"width": pixels.shape[1], "height": pixels.shape[0]}}


_STEPS = 65534
"""Steps from the nearest to the farthest surface: values 1 to 65535; value 0 means no surface."""
_FORMULA = "depth = depth_near + (value - 1) / 65534 * (depth_far - depth_near); value 0: no surface"


def depth_range(depth: FloatArray) -> tuple[float, float] | None:
    """Returns the nearest and the farthest depth, scene units; None if there is no surface."""
    surface = depth[np.isfinite(depth)]
    return (float(surface.min()), float(surface.max())) if surface.size else None


def write_depth_png(path: str | os.PathLike[str], depth: FloatArray) -> None:
    """Writes depths as 16-bit grey: linear from 1 (nearest surface) to 65535 (farthest), 0 without a surface.

    The text chunks ``depth_near``, ``depth_far`` (scene units, along the ray) and ``depth_formula`` hold the decoding.

    Args:
        path: PNG file. It appears complete or not at all.
        depth: Distances along the rays, shape (H, W); not finite without a surface.

    Raises:
        FormatError: The file cannot be written.
    """
    near, far = depth_range(depth) or (0.0, 0.0)
    hit = np.isfinite(depth)
    share = (np.where(hit, depth, near).astype(np.float64) - near) / max(far - near, np.finfo(np.float32).tiny)
    values = np.where(hit, 1.0 + np.rint(_STEPS * share), 0.0).astype(np.uint16)
    write_gray_png(path, values, {"depth_near": f"{near!r}", "depth_far": f"{far!r}", "depth_formula": _FORMULA})
