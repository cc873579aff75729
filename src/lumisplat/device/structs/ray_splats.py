"""Data of Gaussians whose response is that along each pixel's ray. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct


@struct
class RayRasterData:
    """Settings of the rasteriser, in a 1-element array."""

    dilation: float
    """Variance added to Gaussians that are not antialiased, in squared widths of the pixel where they are."""
    sh_degree: int
    """Highest that is evaluated."""
    transmittance_min: float
    depth_iso_transmittance: float
    background: wp.vec3
    """Display-referred sRGB."""
    field: float
    """Of a pinhole: tangent of the angle from its axis up to which points are projected as they are."""


@struct
class PixelBox:
    """Half-open rectangle of pixels; empty for what is culled."""

    x0: int
    y0: int
    x1: int
    y1: int


@struct
class RaySplat:
    """A Gaussian as the rays of pixels meet it, 104 bytes."""

    canonical_from_world: wp.mat33
    """Widened by the footprint of a pixel."""
    eye: wp.vec3
    """Canonical; with a rolling shutter, at the start of the first row."""
    log_opacity: float
    """Natural logarithm."""
    color: wp.vec3
    """Display-referred sRGB, not negative."""
    depth: float
    """By which splats are ordered, above 0."""
    normal: wp.vec3
    """World space, unit, towards the viewer."""
    index: int
    """Among all Gaussians of the scene."""
    box: PixelBox
    """Outside of it, alpha is below 1/255."""


@struct
class WorldGaussian:
    """A Gaussian seen from the eye, world space."""

    point: wp.vec3
    """Its mean, from the eye; with a rolling shutter, from where that is at the start of the first row."""
    axes: wp.mat33
    """Unit axes as columns."""
    scale: wp.vec3
    """Standard deviations, widened by the footprint of a pixel."""


@struct
class ImageMoments:
    """Mean and covariance of what a camera sees of a Gaussian."""

    mean: wp.vec2
    """Pixels."""
    xx: float
    """Pixels^2."""
    xy: float
    yy: float
    error: float
    """By which the rows of a rolling shutter have not found their time, pixels."""


@struct
class ImageBounds:
    """A rectangle of the image, pixels; inf: unbounded."""

    low: wp.vec2
    high: wp.vec2
