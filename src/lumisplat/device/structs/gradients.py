"""Structs of backward passes of the rasteriser and the ray tracer: gradients of a scalar loss."""

import warp as wp

from lumisplat.device.structs import struct


@struct
class PixelGradient:
    """Gradients of the loss with respect to the images of a frame, one element for each pixel."""

    color: wp.array[wp.vec3]
    """d loss / d colour of each pixel; the colour is display-referred and composited over the background."""
    alpha: wp.array[float]


@struct
class SplatGradient:
    """Gradient of the loss with respect to a projected splat, summed over one tile or all pixels; 48 bytes."""

    color: wp.vec3
    log_opacity: float
    center: wp.vec2
    along: float
    shear: float
    across: float
    center_absolute: wp.vec2
    """Sum over pixels of the absolute value of each pixel's gradient with respect to the centre (AbsGS, Ye et al.
    2024)."""
    weight: float
    """Sum over pixels of the blending weight ``transmittance * alpha`` with which the splat is seen."""


@struct
class RaySplatGradient:
    """Gradient of the loss with respect to a Gaussian rasterised along pixel rays; 56 bytes.

    The fields are sums over the rays of one tile or of all pixels. p is the point of a ray nearest to the mean in
    canonical space, and g the derivative of the loss with respect to log(alpha) of the ray. ``point``, ``squares`` and
    ``products`` are the sums of g times the coordinates of p, their squares and their products.
    """

    color: wp.vec3
    log_opacity: float
    weight: float
    """Sum over rays of the blending weight ``transmittance * alpha`` with which the Gaussian is seen."""
    point: wp.vec3
    squares: wp.vec3
    """Sum over rays of ``g * (x^2, y^2, z^2)``.

    (x, y, z) is the point of a ray nearest to the mean, canonical space; g is d loss / d log(alpha) of the ray."""
    products: wp.vec3
    """Sum over rays of ``g * (y z, z x, x y)``.

    (x, y, z) is the point of a ray nearest to the mean, canonical space; g is d loss / d log(alpha) of the ray."""


@struct
class GaussianGradient:
    """Gradients of the loss with respect to the parameters of a Gaussian asset, one element for each Gaussian."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]
    """Gradient with respect to the rotation quaternion. It is orthogonal to the quaternion, whose length has no
    effect."""
    scales: wp.array[wp.vec3]
    opacities: wp.array[float]
    sh: wp.array[wp.vec3]
    """d loss / d SH coefficients, ``sh_count`` consecutive elements for each Gaussian."""
    sh_count: int


@struct
class PoseGradient:
    """Gradient of the loss with respect to the camera pose, summed over a group of Gaussians of one splat instance."""

    camera_from_object: wp.mat33
    camera_from_object_offset: wp.vec3
    eye: wp.vec3
    """Gradient with respect to the eye, object space, only through the view directions at which the SH are evaluated.
    """


@struct
class RayGradient:
    """Gradients of the loss with respect to the output of rays, one element for each ray."""

    color: wp.array[wp.vec3]
    """d loss / d blended colour of each ray."""
    behind: wp.array[float]
    """``dot(d loss / d color, color) + (d loss / d transmittance) * transmittance`` of each ray.

    The backward pass subtracts each hit's term from front to back; the terms of everything behind the hit remain."""


@struct
class HitGradients:
    """Gradients of the loss with respect to the hits of rays: one element for each hit, ray by ray, front to back."""

    ray: wp.array[int]
    log_alpha: wp.array[float]
    """Derivative of the loss with respect to the logarithm of the hit's alpha; 0 where alpha is clamped."""
    weight: wp.array[float]
    """Blending weight of the hit Gaussian, ``transmittance * alpha``."""
