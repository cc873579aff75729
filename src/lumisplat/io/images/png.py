"""PNG files: 8-bit sRGB, and 8-bit and 16-bit grey with text."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.math.arrays import host_array

_log = logging.getLogger("lumisplat")


def write_png(path: PathLike, srgb: npt.ArrayLike) -> None:
    """Writes an 8-bit PNG.

    Args:
        path: The file to write. It appears complete or not at all.
        srgb: Display-referred values, 0..1, shape (H, W, 3 or 4); clamped, and rounded half up. NaN becomes 0, and one
            log line counts such values. Or bytes.

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
    """Writes an 8-bit or a 16-bit grey PNG.

    Args:
        path: The file to write. It appears complete or not at all.
        values: Shape (H, W).
        texts: Text chunks by their keywords, in Latin-1.

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

    Values that are bytes already are returned as they are.

    Raises:
        SceneError: The shape is not that of an image.
    """
    given = np.asarray(host_array(srgb))
    if given.ndim != 3 or given.shape[2] not in (3, 4) or given.size == 0:
        raise SceneError(f"a picture takes (H, W, 3 or 4), got {given.shape}")
    if given.dtype == np.uint8:
        return given.astype(np.uint8, copy=False)
    pixels = np.asarray(given, dtype=np.float32)
    nan_count = np.count_nonzero(np.isnan(pixels))
    if nan_count:
        _log.warning("%s: %d NaN values written as 0", os.fspath(path), nan_count)
    # NaN is replaced before the clamp, which would keep it. Adding 0.5 and truncating rounds half up; np.round would
    # round half to even.
    return (np.clip(np.nan_to_num(pixels, nan=0.0), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
