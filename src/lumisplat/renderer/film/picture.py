"""Host pass: the picture of an unlit frame as bytes, so that who only shows or saves it downloads 4 bytes a pixel."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.device.structs.film import PixelData
from lumisplat.renderer.film import picture_kernels
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.downloads import Copies
from lumisplat.runtime.launcher import Launcher

ReadPicture = Callable[[], npt.NDArray[np.uint8] | None]
"""Fetches a picture; None: some pixels are not finite, and the host has to check them one by one."""


def encoded_pixels(
    launcher: Launcher, buffers: Buffers, pixels: PixelBuffers[PixelData], *, transparent: bool
) -> DeviceArray:
    """The bytes of all pixels, one word each, and a word more, see the kernel."""
    count = pixels.size[0] * pixels.size[1]
    picture = buffers.get("film.picture", wp.uint32, count + 1)
    picture[count:].zero_()
    launcher.run(picture_kernels.encode_pixels, count, transparent, pixels.data, picture)
    return picture


def picture_of(copies: Copies, name: str, size: tuple[int, int], *, transparent: bool) -> ReadPicture:
    """What fetches a picture from copies of its bytes: (H, W, 3), or (H, W, 4) if it is ``transparent``."""

    def read() -> npt.NDArray[np.uint8] | None:
        words = copies.words(name).view(np.uint32)
        if words[-1]:
            return None
        rgba = words[:-1].astype("<u4", copy=False).view(np.uint8).reshape(*reversed(size), 4)
        return rgba if transparent else np.ascontiguousarray(rgba[..., :3])

    return read
