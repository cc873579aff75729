"""Decodes 8-bit images (PNG, JPEG, WebP and others) to sRGB texels, detects damaged files, and writes PNGs."""

from __future__ import annotations

import io
import logging
import os
import warnings
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike, TextureBytes, opened, read_bytes
from lumisplat.math.arrays import host_array

_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TGA", "TIFF")
"""Formats that Pillow decodes itself. For other formats, Pillow would start external programs, such as Ghostscript for
EPS."""

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_SCAN, _END = 0xDA, b"\xff\xd9"
"""JPEG markers for the start of a scan and for the end of the image (ITU-T T.81, table B.1)."""


def read_texture(path: PathLike, total: TextureBytes | None = None) -> npt.NDArray[np.uint8]:
    """Reads an image file; see `decode_texture`.

    Raises:
        FormatError: The image is missing, corrupt or too large.
    """
    return decode_texture(read_bytes(path), path, total=total)


def image_size(path: PathLike) -> tuple[int, int]:
    """Reads width and height from the header of an image file.

    Raises:
        FormatError: The file is missing, or not an image.
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
        raise FormatError(path, "is not a readable image: expected PNG, JPEG or WebP") from error


def decode_texture(
    data: bytes, path: PathLike, label: str | None = None, total: TextureBytes | None = None
) -> npt.NDArray[np.uint8]:
    """Decodes a PNG, JPEG, WebP, BMP, GIF, TGA or TIFF image.

    Args:
        data: The encoded image.
        path: File to name in errors.
        label: Name of the image within the file at ``path``, for errors; None if the file is the image.
        total: Byte counter that limits the memory of all textures of one file; None limits only this image.

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
        raise FormatError(path, f"{where}is corrupt, or not an image: expected PNG, JPEG or WebP") from error


def check_undamaged(path: PathLike) -> None:
    """Raises an error for a truncated image file, and for a PNG that is damaged anywhere.

    A PNG is checked by its checksums, and a JPEG only by its end marker. Images of other formats are decoded.

    Raises:
        FormatError: The image cannot be decoded to its end.
    """
    data = read_bytes(path)
    if _is_whole_png(data) or _is_ended_jpeg(data):
        return
    try:
        decode_texture(data, path)
    except FormatError:
        if not data.startswith((_PNG, _JPEG)):
            raise
        raise FormatError(path, "is truncated or damaged: copy it again, or remove it to leave the image out") from None


def _is_whole_png(data: bytes) -> bool:
    """Returns whether all chunks of a PNG are present with correct checksums."""
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
    """Returns whether the main image of a JPEG has an end marker. Thumbnail and appended data are not considered."""
    if not data.startswith(_JPEG):
        return False
    at = len(_JPEG)
    while at + 4 <= len(data) and data[at] == 0xFF:
        if data[at + 1] == _SCAN:
            return data.find(_END, at) >= 0
        at += 2 + int.from_bytes(data[at + 2 : at + 4])
    return False


_log = logging.getLogger("lumisplat")


def write_png(path: PathLike, srgb: npt.ArrayLike) -> None:
    """Writes an 8-bit PNG.

    Args:
        path: The file to write. It appears complete or not at all.
        srgb: Display-referred values, 0..1, shape (H, W, 3 or 4); clamped, and rounded half up. NaN becomes 0, and a
            log line counts NaN values. An array of bytes (uint8) is written unchanged.

    Raises:
        SceneError: The shape is not that of an image.
        FormatError: The file cannot be written.
    """
    from PIL import Image

    pixels = to_bytes(srgb, path)
    with atomic_write(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")


def write_gray_png(
    path: PathLike, values: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], texts: Mapping[str, str] | None = None
) -> None:
    """Writes an 8-bit or 16-bit grey PNG.

    Args:
        path: The file to write. It appears complete or not at all.
        values: Pixels, shape (H, W).
        texts: Text chunks by keyword, in Latin-1.

    Raises:
        FormatError: The file cannot be written.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    info = PngInfo()
    for keyword, text in (texts or {}).items():
        info.add_text(keyword, text)
    with atomic_write(path) as temporary:
        Image.fromarray(values).save(temporary, format="PNG", pnginfo=info)


def to_bytes(srgb: npt.ArrayLike, path: PathLike) -> npt.NDArray[np.uint8]:
    """Converts display-referred values, 0..1, shape (H, W, 3 or 4), to 8 bits; ``path`` is named in the log.

    An array of bytes (uint8) is returned unchanged.

    Raises:
        SceneError: The shape is not that of an image.
    """
    given = np.asarray(host_array(srgb))
    if given.ndim != 3 or given.shape[2] not in (3, 4) or given.size == 0:
        raise SceneError(f"an image must have shape (H, W, 3 or 4), got {given.shape}")
    if given.dtype == np.uint8:
        return given.astype(np.uint8, copy=False)
    pixels = np.asarray(given, dtype=np.float32)
    nan_count = np.count_nonzero(np.isnan(pixels))
    if nan_count:
        _log.warning("%s: %d NaN values written as 0", os.fspath(path), nan_count)
    # NaN is replaced before the clamp, which would preserve it. Adding 0.5 and truncating rounds half up; np.round
    # rounds half to even.
    return (np.clip(np.nan_to_num(pixels, nan=0.0), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
