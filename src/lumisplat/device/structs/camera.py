"""Structs of cameras, pixel samples, and the film that accumulates them."""

import warp as wp

from lumisplat.device.structs import struct


@struct
class CameraData:
    """Camera parameters for one sample of each pixel.

    The parameters live in a 1-element array, so that a replayed CUDA graph reads their current values.
    """

    world_from_camera: wp.mat33
    """Rotation from camera to world axes; with a rolling shutter, the rotation at the start of the first row."""
    eye: wp.vec3
    """Centre of projection, world space; with a rolling shutter, its position at the start of the first row."""
    model: int
    """Projection model: PINHOLE, FISHEYE or ORTHOGRAPHIC of ``lumisplat.device.camera.camera``."""
    focal: wp.vec2
    """Focal lengths: pixels; for a fisheye, pixels per radian; for an orthographic camera, pixels per scene unit."""
    center: wp.vec2
    """Principal point, pixels."""
    offset: wp.vec2
    """Position of the sample in each pixel, 0..1."""
    raster_center: wp.vec2
    """``center + 0.5 - offset``: the principal point, shifted so that the rasteriser's pixel centres lie at the
    samples."""
    jacobian_min: wp.vec2
    """Smallest x/z and y/z at which the Jacobian of a mean's projection is evaluated; means below use the Jacobian
    there."""
    jacobian_max: wp.vec2
    """Largest x/z and y/z at which the Jacobian of a mean's projection is evaluated; means above use the Jacobian
    there."""
    width: int
    """Width of the rendered image in pixels: that of the cropped window or, without a crop, of the full frame."""
    height: int
    left: int
    """Left edge of the cropped window in the full frame, pixels; 0 without a crop.

    Pixel coordinates and random numbers refer to the full frame, so that a crop equals that part of the full frame.
    """
    top: int
    full_width: int
    """Width of the full frame without a crop, pixels."""
    full_height: int
    tiles_x: int
    tiles_y: int
    near: float
    aperture: float
    """Radius of the lens, scene units; 0: a pinhole."""
    focus_distance: float
    distorted: int
    """1: the lens distorts, with the coefficients ``radial`` and ``tangential``; 0: it does not."""
    radial: wp.vec4
    """Radial distortion coefficients k1 to k4."""
    tangential: wp.vec2
    """Tangential distortion coefficients p1 and p2."""
    distortion_reach: float
    """Undistorted radius, in x/z and y/z, up to which the lens distortion is one-to-one."""
    shutter: int
    """1: rolling shutter; the pose changes from row to row by ``rotation_angle`` and ``motion``. 0: global shutter."""
    rotation_axis: wp.vec3
    """Rolling shutter: axis of the camera's rotation from the first row to the last, world space, unit."""
    rotation_angle: float
    """Rolling shutter: angle by which the camera rotates from the start of the first row to the end of the last,
    radians."""
    motion: wp.vec3
    """Rolling shutter: movement of the eye from the start of the first row to the end of the last, world space."""


@struct
class SampleData:
    """Index and seed of the sample that all pixels currently render, in a 1-element array."""

    index: int
    """Index of the current sample, from 0. With adaptive sampling, some pixels skip it and have rendered fewer
    samples."""
    seed: wp.uint32


@struct
class ListedRays:
    """Camera rays of the pixels that adaptive sampling selects for the current sample; empty arrays: all pixels."""

    ray: wp.array[int]
    """Index of each listed ray among the camera rays of all pixels; -1: the rest of the list is unused."""
    sample: wp.array[int]
    """Number of samples that the ray's pixel has had before this one."""
    offset: wp.array[wp.vec2]
    """Position of the sample in its pixel, 0..1."""


# --- Film ---

TONE_NONE: int = wp.constant(0)

TONE_NEUTRAL: int = wp.constant(1)

TONE_AGX: int = wp.constant(2)


@struct
class PixelData:
    """Images of a frame, one element for each pixel."""

    color: wp.array[wp.vec3]
    """Display-referred sRGB colour, composited over the background.

    In a lit frame, it holds only the captured colour, premultiplied by ``LitPixels.captured_weight``."""
    alpha: wp.array[float]
    """1 - transmittance of the Gaussians; 1 if a mesh, the environment or a visible light lies behind them."""
    depth: wp.array[float]
    """Distance along the pixel's ray to the iso-opacity surface; to the mesh if opacity stays lower; inf: neither
    exists."""
    normal: wp.array[wp.vec3]
    """Surface normal, world space, unit, towards the viewer; zero for an empty pixel."""
    gaussian: wp.array[int]
    """Index, in its own splat instance, of the Gaussian at the iso-opacity surface; -1: no such surface."""
    instance: wp.array[int]
    """Index of the instance whose surface the pixel shows: splat instances first, then mesh instances; -1: none."""


@struct
class LitPixels:
    """Additional images of a lit frame; the arrays are empty in an unlit frame."""

    captured_weight: wp.array[float]
    """Fraction of the pixel that captured colour covers, 0..1: the alpha by which the captured colour is
    premultiplied."""
    light: wp.array[wp.vec3]
    """Linear light that is added to the captured colour; negative where new shadows darken it."""
    color: wp.array[wp.vec3]
    """Linear sum of captured colour and light, written after the last sample."""


@struct
class PixelSums:
    """Sums over the samples of each pixel, in double precision so that 100,000 samples lose no digits."""

    color: wp.array[wp.vec3d]
    """Sum of ``PixelData.color`` over the samples of each pixel.

    ``alpha`` and ``light`` likewise are sums of the fields of that name in `PixelData` and `LitPixels`."""
    alpha: wp.array[wp.float64]
    captured_weight: wp.array[wp.float64]
    """Sum of ``LitPixels.captured_weight`` over the samples of each pixel; empty in an unlit frame, like the sum
    ``light``."""
    light: wp.array[wp.vec3d]
    radiance: wp.array[wp.vec3d]
    """Sum over samples of linear radiance or, in an unlit frame, display-referred colour; the variance is measured on
    it."""
    squares: wp.array[wp.vec3d]
    """Sum over samples of ``(radiance - mean)^2`` per channel; divided by the number of samples - 1, it is the
    variance."""


@struct
class PixelSample:
    """Values that one sample adds to the sums of its pixel."""

    color: wp.vec3
    alpha: float
    captured_weight: float
    light: wp.vec3
    capture_factor: wp.vec3
    """Factor of the sample's captured colour, per channel: below 1 in new shadows, 1: unchanged."""


@struct
class FilmData:
    """The film: images and sums of all pixels, in a 1-element array.

    Kernels take the array by reference, because by value every thread would copy the descriptors of all its arrays.
    """

    width: int
    height: int
    in_blocks: int
    """1: consecutive rays belong to square groups of pixels, as camera rays do; 0: ray i belongs to pixel i, row by
    row."""
    in_sequence: int
    """1: real-time rendering: each sample is a frame of its own, although sample indices go on from frame to frame."""
    first_sample: int
    """Index of the frame's first sample; above 0 only if the frame renders a part of the samples, to be merged with
    others."""
    pixels: PixelData
    lit: LitPixels
    capture_factor: wp.array[wp.vec3]
    """Mean factor by which shadows darken each pixel's captured colour; empty if no splat set is a shadow catcher."""
    captured_all: wp.array[wp.vec3]
    """Mean linear captured colour of each pixel.

    All arrays from ``captured_all`` to ``captured_open`` are empty unless path tracing measures light on shadow
    catchers."""
    captured_part: wp.array[wp.vec3]
    """The part of each pixel's mean linear captured colour that comes from shadow catchers."""
    captured_received: wp.array[wp.vec3]
    """Fraction of each pixel's samples whose path measured the irradiance of a shadow catcher."""
    captured_unshadowed: wp.array[wp.vec3]
    """Mean irradiance of the pixel's shadow catcher by the scene's lights as if the added objects were absent.

    Samples whose path did not measure a shadow catcher count as 0."""
    captured_shadowed: wp.array[wp.vec3]
    """Mean irradiance of the pixel's shadow catcher by the scene's lights with all added objects present."""
    captured_emitted_unshadowed: wp.array[wp.vec3]
    """Mean irradiance of the pixel's shadow catcher by surrounding splats' captured colours, without added objects."""
    captured_emitted_shadowed: wp.array[wp.vec3]
    captured_ambient: wp.array[wp.vec3]
    """Mean ambient irradiance of the pixel's shadow catcher, as the scene specifies it, without added objects."""
    captured_open: wp.array[wp.vec3]
    """Part of the shadow catcher's mean ambient irradiance that no added object blocks."""
    ratio: wp.array[wp.vec3]
    """Factor per channel by which shadows and added light change each pixel's captured colour; set after the last
    sample.

    The array is empty in frames without shadow catchers."""
    count: wp.array[int]
    """Number of samples that each pixel has accumulated; samples with NaN or infinite values are discarded and not
    counted."""
    sums: PixelSums
    """Sums over the samples of each pixel; empty in frames of one sample, whose sample is stored by ``pixels`` and
    ``lit``.
    """
    listed: ListedRays


@struct
class ToneMapData:
    """Settings that convert a lit frame to a display image."""

    straight: int
    """1: the display image has straight alpha, so that colours are divided by alpha; 0: premultiplied."""
    tone_map: int
    """Tone map of linear light: TONE_NONE, TONE_NEUTRAL or TONE_AGX."""
    gain: float
    """Factor that multiplies linear light before the tone map: 2 to the power of the exposure in stops."""
    agx_from_rec709: wp.mat33
    rec2020_from_agx: wp.mat33
    rec709_from_rec2020: wp.mat33
