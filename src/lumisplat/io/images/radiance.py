"""Images of radiance for environment lights: Radiance HDR or OpenEXR, recognised by their content."""

from __future__ import annotations

import logging
import os

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike, parsing, read_bytes
from lumisplat.io.images.exr import read_exr, write_exr
from lumisplat.io.images.hdr import MAGIC as HDR_MAGIC
from lumisplat.io.images.hdr import decode_hdr
from lumisplat.math.arrays import FloatArray

_log = logging.getLogger("lumisplat")

_EXR_MAGIC = b"\x76\x2f\x31\x01"
_DISPLAY_IMAGES = {b"\x89PNG": "a PNG", b"\xff\xd8\xff": "a JPEG", b"RIFF": "a WebP", b"BM": "a BMP", b"GIF8": "a GIF"}


def read_radiance(path: PathLike) -> FloatArray:
    """As `lumisplat.io.load_radiance`."""
    data = read_bytes(path)
    with parsing(path, "an image of radiance (.hdr or .exr)"):
        if data.startswith(HDR_MAGIC):
            image = decode_hdr(path, data)
        elif data.startswith(_EXR_MAGIC):
            image = _exr_colors(path)
        else:
            kinds = [kind for magic, kind in _DISPLAY_IMAGES.items() if data.startswith(magic)]
            found = f"{kinds[0]} image and is 8 bit" if kinds else "neither Radiance HDR nor OpenEXR"
            raise FormatError(path, f"is {found}, expected .hdr or .exr with linear radiance")
    return _without_invalid(path, image)


def write_radiance(path: PathLike, image: FloatArray) -> None:
    """Writes radiance, shape (H, W, 3), as an EXR that `read_radiance` takes.

    Raises:
        FormatError: The file cannot be written.
    """
    write_exr(path, {name: image[..., channel] for channel, name in enumerate("RGB")})


def _exr_colors(path: PathLike) -> FloatArray:
    """The channels R, G and B of an EXR, shape (H, W, 3)."""
    channels = read_exr(path)
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        listed = ", ".join(channels)[:80] or "none"
        raise FormatError(path, f"has no channel {' nor '.join(missing)}, only {listed}: expected R, G and B")
    planes = [channels[name] for name in "RGB"]
    if any(plane.dtype.kind != "f" for plane in planes) or len({plane.shape for plane in planes}) > 1:
        shapes = ", ".join(f"{plane.dtype} {plane.shape}" for plane in planes)
        raise FormatError(path, f"has R, G and B as {shapes}, expected half or float of one size")
    return np.stack(planes, axis=2, dtype=np.float32)


def _without_invalid(path: PathLike, image: FloatArray) -> FloatArray:
    """The image, read-only, with negative and non-finite values set to 0; one log line counts them."""
    not_finite = ~np.isfinite(image)
    with np.errstate(invalid="ignore"):
        negative = (image < 0.0) & ~not_finite
    counts = {"not finite": np.count_nonzero(not_finite), "negative": np.count_nonzero(negative)}
    if any(counts.values()):
        listed = ", ".join(f"{count:,} {problem}" for problem, count in counts.items() if count)
        _log.warning("%s: values set to 0: %s", os.fspath(path), listed)
        image = np.where(not_finite | negative, np.float32(0.0), image)
    image.flags.writeable = False
    return image
