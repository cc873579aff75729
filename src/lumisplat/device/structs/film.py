"""Data of the film: the images of a frame. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct


@struct
class PixelData:
    """The images of a frame, one element a pixel."""

    color: wp.array(dtype=wp.vec3)
    """Display-referred sRGB over the background; of a lit frame only what was captured, premultiplied by its weight."""
    alpha: wp.array(dtype=float)
    """1 - transmittance; 1 where a mesh ends the pixel."""
    depth: wp.array(dtype=float)
    """Distance along the pixel's ray to the iso-opacity surface, scene units; inf: none."""
    normal: wp.array(dtype=wp.vec3)
    """World space, unit, towards the viewer; zero where there is nothing."""
    gaussian: wp.array(dtype=int)
    """Index of the surface's Gaussian in its own instance; -1: none."""
    instance: wp.array(dtype=int)
    """Splat instances first, then mesh instances; -1: none."""


@struct
class LitPixels:
    """What a lit frame keeps beside them; arrays without elements in an unlit one."""

    captured_weight: wp.array(dtype=float)
    """Share of the pixel that was captured."""
    light: wp.array(dtype=wp.vec3)
    """Linear: what light adds or shadows take."""
    color: wp.array(dtype=wp.vec3)
    """Linear: both together, once the last sample is there."""


@struct
class FilmData:
    """The film, in a 1-element array: kernels take it by reference, for the reason that `WaveData` gives."""

    width: int
    height: int
    in_blocks: int
    """1: rays lie in square blocks of pixels, as a camera's; 0: one after the other."""
    pixels: PixelData
    lit: LitPixels
    capture_factor: wp.array(dtype=wp.vec3)
    """Share of the captured colour that shadows leave; without elements where no set is only darkened."""
    nonfinite: wp.array(dtype=int)
    """Samples of each pixel that were not finite."""
