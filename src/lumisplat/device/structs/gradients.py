"""Structs of backward passes of the rasteriser and the ray tracer: gradients of a scalar loss."""

import warp as wp

from lumisplat.device.structs import struct


@struct
class PixelGradient:
    """Gradients of the loss with respect to the images of a frame, one element for each pixel."""

    color: wp.array[wp.vec3]
    """Gradient with respect to the colour over the background."""
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
    """Sum over pixels of the magnitudes of their contributions to ``center`` (AbsGS, Ye et al. 2024)."""
    weight: float
    """Sum of the splat's blending weights."""


@struct
class RaySplatGradient:
    """Gradient of the loss with respect to a Gaussian rasterised along pixel rays; 56 bytes.

    It sums over the rays of one tile or of all pixels. ``point``, ``squares`` and ``products`` are sums of the
    coordinates, their squares and their products, of the point of each ray that is nearest to the mean in canonical
    space. Each term is multiplied by the derivative of the loss with respect to the logarithm of the ray's alpha.
    """

    color: wp.vec3
    log_opacity: float
    weight: float
    """Sum of the Gaussian's blending weights."""
    point: wp.vec3
    squares: wp.vec3
    """Sums of the squared coordinates of the points nearest to the mean."""
    products: wp.vec3
    """Sums of the coordinate products y z, z x and x y of the points nearest to the mean."""


@struct
class GaussianGradient:
    """Gradients of the loss with respect to the parameters of a Gaussian asset, one element for each Gaussian."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]
    """Gradient with respect to the quaternion.

    The gradient is orthogonal to the quaternion, because the quaternion is normalised after each step."""
    scales: wp.array[wp.vec3]
    opacities: wp.array[float]
    sh: wp.array[wp.vec3]
    """SH gradients, ``sh_count`` consecutive elements for each Gaussian."""
    sh_count: int


@struct
class PoseGradient:
    """Gradient of the loss with respect to the camera pose, as far as it comes from some Gaussians of one instance."""

    camera_from_object: wp.mat33
    camera_from_object_offset: wp.vec3
    eye: wp.vec3
    """Gradient with respect to the eye in object space, through the view directions at which SH are evaluated."""


@struct
class RayGradient:
    """Gradients of the loss with respect to the output of rays, one element for each ray."""

    color: wp.array[wp.vec3]
    """Gradient with respect to the ray's colour."""
    behind: wp.array[float]
    """Loss contribution of the whole ray: the sum of its colour and its transmittance, each times its gradient."""


@struct
class HitGradients:
    """Gradients of the loss with respect to the hits of rays: one element for each hit, ray by ray, front to back."""

    ray: wp.array[int]
    log_alpha: wp.array[float]
    """Derivative of the loss with respect to the logarithm of the hit's alpha; 0 where alpha is clamped."""
    weight: wp.array[float]
    """Blending weight of the Gaussian."""
