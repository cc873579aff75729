"""Data of backward passes, of the rasteriser and of rays: derivatives of one number, the loss, by what is drawn."""

import warp as wp

from lumisplat.device.structs import struct


@struct
class PixelGradient:
    """By the images of a frame, an element a pixel."""

    color: wp.array[wp.vec3]
    """By the colour over the background."""
    alpha: wp.array[float]


@struct
class SplatGradient:
    """By a splat, over the pixels of one tile or of all, 48 bytes."""

    color: wp.vec3
    log_opacity: float
    center: wp.vec2
    along: float
    shear: float
    across: float
    center_absolute: wp.vec2
    """Sum of the magnitudes of what pixels add to ``center`` (AbsGS, Ye et al. 2024)."""
    weight: float
    """Sum of the weights with which it is blended."""


@struct
class RaySplatGradient:
    """By a Gaussian that rays of pixels meet, over the pixels of one tile or of all, 56 bytes.

    The last three are sums over the points of rays that are nearest to its mean, in its canonical space, each times the
    derivative by the logarithm of its alpha there.
    """

    color: wp.vec3
    log_opacity: float
    weight: float
    """Sum of the weights with which it is blended."""
    point: wp.vec3
    squares: wp.vec3
    """Of the points' coordinates."""
    products: wp.vec3
    """Of their coordinates y z, z x, x y."""


@struct
class GaussianGradient:
    """By the parameters of a Gaussian asset, an element a Gaussian."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]
    """By a quaternion that is normalised after it has changed: at right angles to it."""
    scales: wp.array[wp.vec3]
    opacities: wp.array[float]
    sh: wp.array[wp.vec3]
    """``sh_count`` consecutive ones a Gaussian."""
    sh_count: int


@struct
class PoseGradient:
    """By where the camera is, of some Gaussians of one instance."""

    camera_from_object: wp.mat33
    camera_from_object_offset: wp.vec3
    eye: wp.vec3
    """In object space, by way of the directions from which colours are seen."""


@struct
class RayGradient:
    """By what rays show, an element a ray."""

    color: wp.array[wp.vec3]
    """By its colour."""
    behind: wp.array[float]
    """What of the loss the ray shows at all, of colour and of transmittance."""


@struct
class HitGradients:
    """By the hits of rays, an element a hit, ray by ray, each front to back."""

    ray: wp.array[int]
    log_alpha: wp.array[float]
    """By the logarithm of alpha; 0 where that is at its limit."""
    weight: wp.array[float]
    """With which the Gaussian is blended."""
