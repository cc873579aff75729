"""One picture from files of its windows, in memory for one row of windows."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.exr import read_exr
from lumisplat.io.images.rows.exr_rows import ExrRows
from lumisplat.io.images.rows.png_rows import PngRows

Window = tuple[int, int, int, int]
"""Left, top, width and height, pixels."""


def join_windows(path: PathLike, windows: Mapping[Window, PathLike]) -> None:
    """Writes the picture that files of its windows (`Camera.window`) are cut from, pixel by pixel as they are.

    Args:
        path: The picture, ``.png`` (8-bit RGB or RGBA) or ``.exr`` (all channels of the windows' files). It appears
            complete or not at all.
        windows: Files of one format by the windows that they show. These stand in rows, without gaps, and windows in a
            row are of one height.

    Raises:
        SceneError: The windows are none of a picture.
        FormatError: A file is missing, damaged, or does not fit the others; the picture cannot be written, or its
            extension is another.
    """
    rows = _in_rows(windows)
    size = max(left + width for left, _, width, _ in windows), max(top + height for _, top, _, height in windows)
    suffix = Path(path).suffix.lower()
    if suffix not in (".png", ".exr"):
        raise FormatError(path, f"pictures are joined in .png and .exr, not in '{suffix}'")
    join = _join_png if suffix == ".png" else _join_exr
    join(path, [{window: windows[window] for window in row} for row in rows], size)


def _in_rows(windows: Mapping[Window, PathLike]) -> list[list[Window]]:
    """The windows row by row, each from left to right.

    Raises:
        SceneError: They leave gaps, overlap, or differ in height within a row.
    """
    if not windows:
        raise SceneError("a picture needs a window")
    rows = [
        [window for window in sorted(windows) if window[1] == top] for top in sorted({window[1] for window in windows})
    ]
    right, bottom = rows[0][-1][0] + rows[0][-1][2], 0
    for row in rows:
        beside = 0
        for left, top, width, height in row:
            if left != beside or top != bottom or height != row[0][3]:
                raise SceneError(f"the window ({left}, {top}, {width}, {height}) leaves a gap, or overlaps another one")
            beside = left + width
        if beside != right:
            raise SceneError(f"the windows at row {bottom} end at column {beside}, others at {right}")
        bottom += row[0][3]
    return rows


def _join_png(path: PathLike, rows: list[dict[Window, PathLike]], size: tuple[int, int]) -> None:
    first = next(iter(rows[0].items()))
    channels = _png_pixels(first[1], first[0], None).shape[2]
    with atomic_write(path) as temporary, open(temporary, "wb") as file, PngRows(file, *size, channels) as written:
        for row in rows:
            parts = [_png_pixels(part, window, channels) for window, part in row.items()]
            written.write(np.concatenate(parts, axis=1))


def _png_pixels(path: PathLike, window: Window, channels: int | None) -> npt.NDArray[np.uint8]:
    """The pixels of a window's PNG, (H, W, 3 or 4)."""
    from PIL import Image

    try:
        Image.MAX_IMAGE_PIXELS, limit = None, Image.MAX_IMAGE_PIXELS  # the size is checked against the window's
        try:
            with Image.open(path, formats=("PNG",)) as image:
                if image.size != window[2:] or image.mode not in ("RGB", "RGBA"):
                    raise FormatError(path, f"is {image.size} {image.mode}, expected {window[2:]} in RGB or RGBA")
                pixels = np.asarray(image)
        finally:
            Image.MAX_IMAGE_PIXELS = limit
    except FormatError:
        raise
    except (OSError, SyntaxError, ValueError) as error:
        raise FormatError(path, f"cannot be read as a window of a picture: {error}") from None
    if channels is not None and pixels.shape[2] != channels:
        raise FormatError(path, f"has {pixels.shape[2]} channels, other windows {channels}")
    return pixels


def _join_exr(path: PathLike, rows: list[dict[Window, PathLike]], size: tuple[int, int]) -> None:
    first = next(iter(rows[0].items()))
    kinds = {name: image.dtype.kind for name, image in _exr_channels(first[1], first[0], None).items()}
    with atomic_write(path) as temporary, open(temporary, "wb") as file, ExrRows(file, *size, kinds) as written:
        for row in rows:
            parts = [_exr_channels(part, window, kinds) for window, part in row.items()]
            written.write({name: np.concatenate([part.pop(name) for part in parts], axis=1) for name in kinds})


def _exr_channels(path: PathLike, window: Window, kinds: Mapping[str, str] | None) -> dict[str, npt.NDArray[Any]]:
    """The channels of a window's EXR."""
    channels = read_exr(path)
    shapes = {image.shape for image in channels.values()}
    if shapes != {(window[3], window[2])}:
        raise FormatError(path, f"has {shapes} rows and columns, expected {(window[3], window[2])}")
    if kinds is not None and {name: image.dtype.kind for name, image in channels.items()} != dict(kinds):
        raise FormatError(path, "has other channels than other windows")
    return channels
