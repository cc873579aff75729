"""Data of cameras, of the samples of their pixels, and of the film: the images of a frame."""

import warp as wp

from lumisplat.device.structs import struct


@struct
class CameraData:
    """A camera for one sample of each pixel. Lives in a 1-element array, so that captured graphs read its changes."""

    world_from_camera: wp.mat33
    """Rotation; with a rolling shutter, at the start of the first row."""
    eye: wp.vec3
    """Centre of projection, world space; with a rolling shutter, at the start of the first row."""
    model: int
    """PINHOLE, FISHEYE or ORTHOGRAPHIC of ``lumisplat.device.camera.camera``."""
    focal: wp.vec2
    """Pixels; fisheye: per radian, orthographic: per scene unit."""
    center: wp.vec2
    """Principal point, pixels."""
    offset: wp.vec2
    """Position of the sample in each pixel, 0..1."""
    raster_center: wp.vec2
    """The principal point, moved so that the rasteriser's pixel centres are the samples: plus 0.5, minus ``offset``."""
    jacobian_min: wp.vec2
    """Lowest x/z and y/z at which the projection is linearised."""
    jacobian_max: wp.vec2
    """Highest x/z and y/z at which the projection is linearised."""
    width: int
    """Of the image: of the window that is drawn, or of the whole picture; pixels."""
    height: int
    left: int
    """Of the window in the picture, pixels. Coordinates and random numbers are those of the picture."""
    top: int
    full_width: int
    """Of the whole picture, pixels."""
    full_height: int
    tiles_x: int
    tiles_y: int
    near: float
    aperture: float
    """Radius of the lens, scene units; 0: a pinhole."""
    focus_distance: float
    distorted: int
    """1: the lens distorts, by the next three."""
    radial: wp.vec4
    """Coefficients k1 to k4."""
    tangential: wp.vec2
    """Coefficients p1 and p2."""
    distortion_reach: float
    """Radius up to which the distortion is one to one, before it is applied."""
    shutter: int
    """1: a rolling shutter, the pose changes from row to row by the next three."""
    rotation_axis: wp.vec3
    """Axis of the rotation while the rows are exposed, world space, unit."""
    rotation_angle: float
    """Its angle at the end of the last row, radians."""
    motion: wp.vec3
    """Translation of the eye until then, world space."""


@struct
class SampleData:
    """The current sample of each pixel. Lives in a 1-element array."""

    index: int
    """From 0; where some pixels have fewer samples than others, the number in those that have all."""
    seed: wp.uint32


@struct
class ListedRays:
    """The rays of those pixels that a sample is drawn for, in the order of all; without elements: all pixels' rays."""

    ray: wp.array[int]
    """Of the ray among those of all pixels; -1: there is none."""
    sample: wp.array[int]
    """Number of the sample in its pixel."""
    offset: wp.array[wp.vec2]
    """Position of the sample in its pixel, 0..1."""


# --- The film ---

TONE_NONE: int = wp.constant(0)

TONE_NEUTRAL: int = wp.constant(1)

TONE_AGX: int = wp.constant(2)


@struct
class PixelData:
    """The images of a frame, one element a pixel."""

    color: wp.array[wp.vec3]
    """Display-referred sRGB over the background; of a lit frame only what was captured, premultiplied by its weight."""
    alpha: wp.array[float]
    """1 - transmittance; 1 where a mesh ends the pixel."""
    depth: wp.array[float]
    """Distance along the pixel's ray to the iso-opacity surface, scene units; inf: none."""
    normal: wp.array[wp.vec3]
    """World space, unit, towards the viewer; zero where there is nothing."""
    gaussian: wp.array[int]
    """Index of the surface's Gaussian in its own instance; -1: none."""
    instance: wp.array[int]
    """Splat instances first, then mesh instances; -1: none."""


@struct
class LitPixels:
    """The further images of a lit frame; arrays without elements in an unlit one."""

    captured_weight: wp.array[float]
    """Share of the pixel that was captured."""
    light: wp.array[wp.vec3]
    """Linear: light that is added or, if negative, taken by shadows."""
    color: wp.array[wp.vec3]
    """Linear: captured colour plus light, written after the last sample."""


@struct
class PixelSums:
    """Sums over the samples of each pixel, in double precision: means and variances of 100,000 samples lose nothing."""

    color: wp.array[wp.vec3d]
    """Of what `PixelData` and `LitPixels` have the means of."""
    alpha: wp.array[wp.float64]
    captured_weight: wp.array[wp.float64]
    """Like ``light`` without elements in an unlit frame."""
    light: wp.array[wp.vec3d]
    radiance: wp.array[wp.vec3d]
    """Of what the variance is of: linear radiance; in an unlit frame its display-referred colour."""
    squares: wp.array[wp.vec3d]
    """Of the squared deviations of that from its mean."""


@struct
class PixelSample:
    """What a sample adds to those sums."""

    color: wp.vec3
    alpha: float
    captured_weight: float
    light: wp.vec3
    capture_factor: wp.vec3
    """Share of the captured colour that shadows leave."""


@struct
class FilmData:
    """The film, in a 1-element array: kernels take it by reference, for the reason that `WaveData` gives."""

    width: int
    height: int
    in_blocks: int
    """1: rays lie in square blocks of pixels, as a camera's; 0: one after the other."""
    in_sequence: int
    """1: each sample is a frame of its own, whatever its number."""
    first_sample: int
    """Number of the first sample that is added: 0, but in parts of a frame."""
    pixels: PixelData
    lit: LitPixels
    capture_factor: wp.array[wp.vec3]
    """Mean over samples of the share of the captured colour that shadows leave, as of `RayRadiance.capture_factor`;
    without elements if no splat set is shadow-only."""
    captured_all: wp.array[wp.vec3]
    """It, linear, the mean over samples; like the next eight without elements unless paths find what shadow-only
    surfaces receive."""
    captured_part: wp.array[wp.vec3]
    """The part of it that is a shadow-only surface's."""
    captured_received: wp.array[wp.vec3]
    """Share of the samples that found the next two."""
    captured_unshadowed: wp.array[wp.vec3]
    """Irradiance of the surface by lights, as it was captured, a mean in which the other samples count as 0."""
    captured_shadowed: wp.array[wp.vec3]
    """The same with all that was added."""
    captured_emitted_unshadowed: wp.array[wp.vec3]
    """Irradiance by the captures around it, as of `RayRadiance.own_sent`."""
    captured_emitted_shadowed: wp.array[wp.vec3]
    captured_ambient: wp.array[wp.vec3]
    """Ambient irradiance."""
    captured_open: wp.array[wp.vec3]
    """The part of it that nothing added blocks."""
    ratio: wp.array[wp.vec3]
    """What shadows leave of the captured part of a pixel, or light makes of it, once all samples are drawn; without
    elements in frames without shadow catchers."""
    count: wp.array[int]
    """Samples of each pixel that were finite, which alone count."""
    sums: PixelSums
    """Without elements in frames of one sample, whose values ``pixels`` and ``lit`` hold."""
    listed: ListedRays


@struct
class ToneMapData:
    """How a lit frame becomes a picture."""

    straight: int
    """1: colours are divided by alpha."""
    tone_map: int
    """TONE_NONE and so on."""
    gain: float
    """2 to the power of the exposure."""
    agx_from_rec709: wp.mat33
    rec2020_from_agx: wp.mat33
    rec709_from_rec2020: wp.mat33
