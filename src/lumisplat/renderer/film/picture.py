"""Encodes frames to 8-bit images on the device, so that display and saving download only 4 bytes a pixel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import ToneMap
from lumisplat.device.structs.camera import TONE_AGX, TONE_NEUTRAL, TONE_NONE, LitPixels, PixelData, ToneMapData
from lumisplat.frame.frame import ReadPicture
from lumisplat.math.tone_map import AGX_FROM_REC709, REC709_FROM_REC2020, REC2020_FROM_AGX, exposure_gain
from lumisplat.renderer.film import picture_kernels
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.downloads import Copies
from lumisplat.runtime.launcher import Launcher

_TONE_MAPS = {ToneMap.NONE: TONE_NONE, ToneMap.NEUTRAL: TONE_NEUTRAL, ToneMap.AGX: TONE_AGX}


def encoded_pixels(
    launcher: Launcher, buffers: Buffers, pixels: PixelBuffers[PixelData], *, transparent: bool
) -> DeviceArray:
    """Encodes an unlit frame to one RGBA word a pixel, and a last word that is 1 if a pixel is not finite."""
    picture = _empty_picture(buffers, pixels)
    launcher.run_banded(picture_kernels.encode_pixels, len(picture) - 1, transparent, pixels.data, picture)
    return picture


def encoded_lit_pixels(
    launcher: Launcher,
    buffers: Buffers,
    pixels: PixelBuffers[PixelData],
    lit: PixelBuffers[LitPixels],
    display: ToneMapData,
) -> DeviceArray:
    """Encodes a lit frame in the format of `encoded_pixels`.

    The bytes equal the host's, except where a value lies halfway between two bytes.
    """
    picture = _empty_picture(buffers, pixels)
    inputs = display, pixels.data, lit.data, picture
    launcher.run_banded(picture_kernels.encode_lit_pixels, len(picture) - 1, *inputs)
    return picture


def picture_data(exposure: float, tone_map: ToneMap, *, transparent: bool) -> ToneMapData:
    """Returns the display transform of a lit frame for kernels: exposure, tone map and alpha mode."""
    data = ToneMapData()
    data.straight, data.tone_map, data.gain = int(transparent), _TONE_MAPS[tone_map], exposure_gain(exposure)
    data.agx_from_rec709 = wp.mat33(*AGX_FROM_REC709.ravel())
    data.rec2020_from_agx = wp.mat33(*REC2020_FROM_AGX.ravel())
    data.rec709_from_rec2020 = wp.mat33(*REC709_FROM_REC2020.ravel())
    return data


def _empty_picture(buffers: Buffers, pixels: PixelBuffers[PixelData]) -> DeviceArray:
    """Returns an array of one word a pixel, and a last word set to 0 ("all pixels are finite")."""
    count = pixels.size[0] * pixels.size[1]
    picture = buffers.get("film.picture", wp.uint32, count + 1)
    picture[count:].zero_()
    return picture


def picture_of(copies: Copies, name: str, size: tuple[int, int], *, transparent: bool) -> ReadPicture:
    """Returns a function that fetches the 8-bit image from copies: (H, W, 3), or (H, W, 4) if ``transparent``.

    The function returns None if a pixel is not finite.
    """

    def read() -> npt.NDArray[np.uint8] | None:
        words = copies.words(name).view(np.uint32)
        if words[-1]:
            return None
        rgba = words[:-1].astype("<u4", copy=False).view(np.uint8).reshape(*reversed(size), 4)
        return rgba if transparent else np.ascontiguousarray(rgba[..., :3])

    return read
