"""Images: textures in; PNG (8-bit sRGB), EXR (float layers named as in Nuke) and NPZ out.

Files appear whole or not at all: writers go through `atomic_write`.
"""

from __future__ import annotations

import io
import logging
import os
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.limits import check_expansion
from lumisplat.io.files.source import PathLike, parsing, read_bytes

_log = logging.getLogger("lumisplat")


def write_png(path: PathLike, srgb: npt.ArrayLike) -> None:
    """Writes an 8-bit PNG.

    Args:
        path: Where to.
        srgb: Display-referred values, 0..1, shape (H, W, 3 or 4); clamped, and rounded half up. NaN becomes 0, and one
            log line counts them.

    Raises:
        SceneError: The shape is not that of an image.
        FormatError: The file cannot be written.
    """
    from PIL import Image

    pixels = to_bytes(srgb, path)
    with atomic_write(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG")


def to_bytes(srgb: npt.ArrayLike, path: PathLike) -> npt.NDArray[np.uint8]:
    """8 bits of display-referred values, 0..1, shape (H, W, 3 or 4), as `write_png` writes them; ``path`` is for it.

    Raises:
        SceneError: The shape is not that of an image.
    """
    pixels = np.asarray(srgb, dtype=np.float32)
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or pixels.size == 0:
        raise SceneError(f"a picture takes (H, W, 3 or 4), got {pixels.shape}")
    nan_count = np.count_nonzero(np.isnan(pixels))
    if nan_count:
        _log.warning("%s: %d NaN values written as 0", os.fspath(path), nan_count)
    # NaN to 0 before the clamp, which keeps it; +0.5 and truncation round half up, where np.round would go to even.
    return (np.clip(np.nan_to_num(pixels, nan=0.0), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def write_exr(path: PathLike, channels: Mapping[str, npt.NDArray], metadata: Mapping[str, str] | None = None) -> None:
    """Writes a one-part scanline EXR, ZIP-compressed, with channels exactly as named (Nuke reads ``layer.channel``).

    Args:
        path: Where to.
        channels: ``"R"``, ``"depth.Z"``, ``"normal.X"``, ...: all of one shape (H, W). Floating-point arrays become
            32-bit float (infinities are kept), integer ones 32-bit unsigned: -1 ("none") reads back as 4294967295.
        metadata: Header attributes.

    Raises:
        SceneError: No channel, or shapes differ.
        FormatError: The file cannot be written.
    """
    import OpenEXR

    shapes = {np.shape(pixels) for pixels in channels.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2 or 0 in next(iter(shapes)):
        raise SceneError(f"EXR channels must share one shape (H, W), got {sorted(shapes) or 'no channel'}")
    # One channel per name: given an (H, W, 3) array, OpenEXR would name its channels .R .G .B whatever they mean.
    planes = {name: _exr_plane(np.asarray(pixels)) for name, pixels in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(metadata or {})}
    with atomic_write(path) as temporary, OpenEXR.File(header, planes) as file:
        Path(temporary).touch()  # an OSError where the folder cannot be written; OpenEXR would say less
        try:
            file.write(os.fspath(temporary))
        except RuntimeError as error:
            raise FormatError(path, f"cannot be written: {error}") from None


def write_npz(path: PathLike, arrays: Mapping[str, npt.ArrayLike]) -> None:
    """Writes named arrays as they are, compressed.

    Raises:
        FormatError: The file cannot be written.
    """
    with atomic_write(path) as temporary, Path(temporary).open("wb") as stream:
        named = {name: np.asarray(array) for name, array in arrays.items()}
        np.savez_compressed(stream, **named)  # pyright: ignore[reportArgumentType]


def read_image(path: PathLike) -> dict[str, npt.NDArray]:
    """Reads back what the writers above write.

    Returns:
        PNG: ``{"srgb": (H, W, 3 or 4) uint8}``. EXR: each channel by its full name, (H, W) float32 or uint32.
        NPZ: the arrays by name.

    Raises:
        FormatError: The file cannot be read, or has another extension.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".png":
        return {"srgb": read_texture(path)}
    if suffix == ".exr":
        return read_exr(path)
    if suffix == ".npz":
        with parsing(path, "an NPZ file"), np.load(io.BytesIO(read_bytes(path))) as arrays:
            return dict(arrays)
    raise FormatError(path, "is not a .png, .exr or .npz image")


def read_texture(path: PathLike, *, wanted_by: PathLike | None = None) -> npt.NDArray[np.uint8]:
    """Reads an image file; see `decode_texture`.

    Args:
        path: What to read.
        wanted_by: The file that refers to it, named in the error.

    Raises:
        FormatError: The image is missing, corrupt, or absurdly large.
    """
    return decode_texture(read_bytes(path, wanted_by=wanted_by), path)


def decode_texture(data: bytes, path: PathLike, label: str = "") -> npt.NDArray[np.uint8]:
    """Decodes PNG, JPEG, WebP or whatever else Pillow reads.

    Args:
        data: The encoded image.
        path: The file to name in errors.
        label: Which image inside that file, to name in errors; empty: the file itself.

    Returns:
        sRGB-encoded texels, shape (H, W, 3), or (H, W, 4) where the image has transparency; row 0 on top.

    Raises:
        FormatError: The image is corrupt, or absurdly large.
    """
    from PIL import Image

    where = label and f"texture {label} "
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data)) as image:
                if image.mode.startswith("I"):  # 16-bit grey: Pillow would clamp it at 255
                    grey = (np.asarray(image).astype(np.uint32) >> 8).clip(0, 255).astype(np.uint8)
                    return np.repeat(grey[:, :, None], 3, axis=2)
                opaque = not image.has_transparency_data
                return np.asarray(image.convert("RGB" if opaque else "RGBA"))
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise FormatError(path, f"{where}is too large to decode: {error}") from None
    except Exception as error:  # Pillow's decoders raise whatever their format's parser does
        raise FormatError(path, f"{where}is corrupt, or no image: expected PNG, JPEG or WebP") from error


def _exr_plane(pixels: npt.NDArray) -> npt.NDArray:
    if pixels.dtype.kind in "iub":
        return np.ascontiguousarray(pixels).astype(np.int64).astype(np.uint32)
    return np.ascontiguousarray(pixels, dtype=np.float32)


def read_exr(path: PathLike) -> dict[str, npt.NDArray]:
    """The channels of an EXR's first part by their full names, each (H, W) float16, float32 or uint32.

    Raises:
        FormatError: The file is missing, damaged, claims more pixels than its size can hold, or is no EXR.
    """
    import OpenEXR

    stored_bytes = len(read_bytes(path))
    try:
        with OpenEXR.File(os.fspath(path), header_only=True) as file:
            low, high = file.header()["dataWindow"]
            count = len(file.header()["channels"])
        width, height = (int(size) for size in np.subtract(high, low) + 1)
        check_expansion(
            path, f"{width} x {height} pixels of {count} channels", 4 * width * height * count, stored_bytes
        )
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            return {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except FormatError:
        raise
    except Exception as error:  # the binding raises RuntimeError, TypeError or its own, by the place it stumbles
        raise FormatError(path, f"damaged, or not an EXR file: {' '.join(str(error).split())}") from error
