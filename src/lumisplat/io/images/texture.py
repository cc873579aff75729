"""Textures: PNG, JPEG, WebP and some more formats, as sRGB texels."""

from __future__ import annotations

import io
import os
import warnings

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.limits import TextureBytes
from lumisplat.io.files.source import PathLike, opened, read_bytes

_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TGA", "TIFF")
"""Formats that Pillow decodes by itself: for others it starts programs, such as Ghostscript for EPS."""


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
