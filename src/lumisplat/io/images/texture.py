"""Decodes textures (PNG, JPEG, WebP and some more) as sRGB texels, and finds damaged image files."""

from __future__ import annotations

import io
import os
import warnings

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike, TextureBytes, opened, read_bytes

_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TGA", "TIFF")
"""Formats that Pillow decodes by itself: for others it starts programs, such as Ghostscript for EPS."""

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_SCAN, _END = 0xDA, b"\xff\xd9"
"""Markers of a JPEG: its pixels begin, and they have ended (ITU-T T.81, table B.1)."""


def read_texture(path: PathLike, total: TextureBytes | None = None) -> npt.NDArray[np.uint8]:
    """Reads an image file; see `decode_texture`.

    Raises:
        FormatError: The image is missing, corrupt or too large.
    """
    return decode_texture(read_bytes(path), path, total=total)


def image_size(path: PathLike) -> tuple[int, int]:
    """Width and height of an image file, from its header.

    Raises:
        FormatError: The file is missing, or no image.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with opened(path) as file, Image.open(file, formats=_FORMATS) as image:
                return image.size
    except FormatError:
        raise
    except Exception as error:  # Pillow's decoders raise many kinds of errors
        raise FormatError(path, "cannot be read for its size: expected PNG, JPEG or WebP") from error


def decode_texture(
    data: bytes, path: PathLike, label: str | None = None, total: TextureBytes | None = None
) -> npt.NDArray[np.uint8]:
    """Decodes a PNG, JPEG, WebP, BMP, GIF, TGA or TIFF image.

    Args:
        data: The encoded image.
        path: The file to name in errors.
        label: The image inside of that file, to name in errors; None: the file is the image.
        total: The textures of the file that this one belongs to, which are bounded together.

    Returns:
        sRGB-encoded texels, shape (H, W, 3), or (H, W, 4) if the image has transparency; row 0 at the top.

    Raises:
        FormatError: The image is corrupt or too large.
    """
    from PIL import Image

    where = f"texture {label} " if label else ""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                if total is not None:
                    total.add(label or os.fspath(path), 3 * image.width * image.height, len(data))
                if image.mode.startswith("I"):  # 16-bit grey, which Pillow would clamp at 255
                    grey = (np.asarray(image).astype(np.uint32) >> 8).clip(0, 255).astype(np.uint8)
                    return np.repeat(grey[:, :, None], 3, axis=2)
                opaque = not image.has_transparency_data
                return np.asarray(image.convert("RGB" if opaque else "RGBA"))
    except FormatError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise FormatError(path, f"{where}is too large to decode: {error}") from None
    except Exception as error:  # Pillow's decoders raise many kinds of errors
        raise FormatError(path, f"{where}is corrupt, or no image: expected PNG, JPEG or WebP") from error


def check_undamaged(path: PathLike) -> None:
    """Refuses an image file that is cut off, and a PNG that is damaged anywhere.

    What a PNG's checksums or the end of a JPEG's picture do not show to be whole is decoded.

    Raises:
        FormatError: It cannot be decoded to its end.
    """
    data = read_bytes(path)
    if _is_whole_png(data) or _is_ended_jpeg(data):
        return
    try:
        decode_texture(data, path)
    except FormatError:
        if not data.startswith((_PNG, _JPEG)):
            raise
        raise FormatError(
            path, "is cut off or damaged: copy it anew, or remove it, and the photograph is left out"
        ) from None


def _is_whole_png(data: bytes) -> bool:
    """Whether all of its parts are there, with the checksums that they should have."""
    from PIL import Image

    if not data.startswith(_PNG):
        return False
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            image.verify()
    except Exception:  # Pillow's decoders raise many kinds of errors
        return False
    return True


def _is_ended_jpeg(data: bytes) -> bool:
    """Whether its picture has an end: not that of a thumbnail before it, nor of what some cameras append."""
    if not data.startswith(_JPEG):
        return False
    at = len(_JPEG)
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == _SCAN:
            return data.find(_END, at) >= 0
        at += 2 + int.from_bytes(data[at + 2 : at + 4])
    return False
