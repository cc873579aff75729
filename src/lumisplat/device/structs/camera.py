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
    """PINHOLE, FISHEYE or ORTHOGRAPHIC of ``lumisplat.device.camera.camera``."""
    focal: wp.vec2
    """Focal lengths: pixels; for a fisheye, pixels per radian; for an orthographic camera, pixels per scene unit."""
    center: wp.vec2
    """Principal point, pixels."""
    offset: wp.vec2
    """Position of the sample in each pixel, 0..1."""
    raster_center: wp.vec2
    """Principal point plus 0.5 minus ``offset``: makes the rasteriser's pixel centres coincide with the samples."""
    jacobian_min: wp.vec2
    """Smallest x/z and y/z at which the projection's Jacobian is evaluated; Gaussians farther out use the Jacobian
    there."""
    jacobian_max: wp.vec2
    """Largest x/z and y/z at which the projection's Jacobian is evaluated; Gaussians farther out use the Jacobian
    there."""
    width: int
    """Width of the rendered window (or of the full frame, without a window), pixels."""
    height: int
    left: int
    """Left edge of the window in the full frame, pixels.

    Pixel coordinates and random numbers refer to the full frame, so that a window renders the same pixels.
    """
    top: int
    full_width: int
    """Width of the full frame, pixels."""
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
    """Undistorted radius up to which the lens distortion is one-to-one."""
    shutter: int
    """1: rolling shutter; the pose changes from row to row by ``rotation_angle`` and ``motion``. 0: global shutter."""
    rotation_axis: wp.vec3
    """Axis of the camera's rotation while the rows are exposed, world space, unit."""
    rotation_angle: float
    """Angle by which the camera has rotated at the end of the last row, radians."""
    motion: wp.vec3
    """Translation of the eye from the start of the first row to the end of the last row, world space."""


@struct
class SampleData:
    """The current sample of each pixel, in a 1-element array."""

    index: int
    """Index of the current sample, from 0.

    Adaptive sampling skips pixels; the index is then that of pixels that receive every sample."""
    seed: wp.uint32


@struct
class ListedRays:
    """Rays of the pixels that adaptive sampling selects for this sample; empty arrays: the rays of all pixels."""

    ray: wp.array[int]
    """Index of the ray among the rays of all pixels; -1: the element lists no ray."""
    sample: wp.array[int]
    """Index of the sample within its pixel."""
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
    """Colour over the background, display-referred sRGB.

    In a lit frame, it is only the captured colour of the pixel, premultiplied by its weight."""
    alpha: wp.array[float]
    """Opacity, 1 - transmittance; 1 where the pixel ends at a mesh."""
    depth: wp.array[float]
    """Distance along the pixel's ray to the iso-opacity surface, scene units; inf: no surface."""
    normal: wp.array[wp.vec3]
    """Surface normal, world space, unit, towards the viewer; zero for an empty pixel."""
    gaussian: wp.array[int]
    """Index of the surface's Gaussian in its own instance; -1: none."""
    instance: wp.array[int]
    """Index of the instance, splat instances first, then mesh instances; -1: none."""


@struct
class LitPixels:
    """Additional images of a lit frame; the arrays are empty in an unlit frame."""

    captured_weight: wp.array[float]
    """Fraction of the pixel's colour that is captured colour."""
    light: wp.array[wp.vec3]
    """Linear light that adds to the captured colour; negative where shadows remove light."""
    color: wp.array[wp.vec3]
    """Linear sum of captured colour and light, written after the last sample."""


@struct
class PixelSums:
    """Sums over the samples of each pixel, in double precision so that 100,000 samples lose no digits."""

    color: wp.array[wp.vec3d]
    """Sum of ``PixelData.color``; the other fields are sums of the fields of the same name in `PixelData` and
    `LitPixels`."""
    alpha: wp.array[wp.float64]
    captured_weight: wp.array[wp.float64]
    """Sum of ``LitPixels.captured_weight``; empty in an unlit frame, like the sum ``light``."""
    light: wp.array[wp.vec3d]
    radiance: wp.array[wp.vec3d]
    """Sum of the values whose variance is measured: linear radiance, or display-referred colour in an unlit frame."""
    squares: wp.array[wp.vec3d]
    """Sum of the squared deviations of ``radiance`` from its mean."""


@struct
class PixelSample:
    """Values that one sample adds to the sums of its pixel."""

    color: wp.vec3
    alpha: float
    captured_weight: float
    light: wp.vec3
    capture_factor: wp.vec3
    """Fraction of the captured colour that remains after shadows."""


@struct
class FilmData:
    """The film: images and sums of all pixels, in a 1-element array.

    Kernels take the array by reference, because by value every thread would copy the descriptors of all its arrays.
    """

    width: int
    height: int
    in_blocks: int
    """1: rays are ordered in square groups of pixels, as camera rays are; 0: rays are in row order."""
    in_sequence: int
    """1: every sample starts a new frame of a real-time sequence, even if the index of the sample is above 0."""
    first_sample: int
    """Index of the first sample of the frame; above 0 only in partial frames, which render a range of the samples."""
    pixels: PixelData
    lit: LitPixels
    capture_factor: wp.array[wp.vec3]
    """Mean fraction of the captured colour that remains after shadows; empty if no splat set is a shadow catcher."""
    captured_all: wp.array[wp.vec3]
    """Mean linear captured colour.

    The arrays from ``captured_all`` to ``captured_open`` are empty unless path tracing measures light on shadow
    catchers."""
    captured_part: wp.array[wp.vec3]
    """Part of ``captured_all`` that shadow catchers contribute."""
    captured_received: wp.array[wp.vec3]
    """Fraction of the samples that measured the irradiance of a shadow catcher."""
    captured_unshadowed: wp.array[wp.vec3]
    """Mean irradiance of the shadow catcher by lights, without added objects.

    Samples without a measurement count as 0."""
    captured_shadowed: wp.array[wp.vec3]
    """Mean irradiance of the shadow catcher by lights, with all added objects."""
    captured_emitted_unshadowed: wp.array[wp.vec3]
    """Mean irradiance of the shadow catcher by the radiance of surrounding captures, without added objects."""
    captured_emitted_shadowed: wp.array[wp.vec3]
    captured_ambient: wp.array[wp.vec3]
    """Mean ambient irradiance of the shadow catcher."""
    captured_open: wp.array[wp.vec3]
    """Part of ``captured_ambient`` that no added object blocks."""
    ratio: wp.array[wp.vec3]
    """Factor by which shadows and added light change the pixel's captured colour, computed after the last sample.

    The array is empty in frames without shadow catchers."""
    count: wp.array[int]
    """Number of finite samples of each pixel; other samples are discarded."""
    sums: PixelSums
    """Sums over samples; empty in frames of one sample, whose values are stored in ``pixels`` and ``lit``."""
    listed: ListedRays


@struct
class ToneMapData:
    """Settings that convert a lit frame to a display image."""

    straight: int
    """1: colours are divided by alpha."""
    tone_map: int
    """TONE_NONE, TONE_NEUTRAL or TONE_AGX."""
    gain: float
    """2 to the power of the exposure."""
    agx_from_rec709: wp.mat33
    rec2020_from_agx: wp.mat33
    rec709_from_rec2020: wp.mat33
