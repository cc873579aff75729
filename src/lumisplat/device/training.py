"""Structs of training: parameters, optimiser steps, losses, images, pixel weights, and incident light."""

import warp as wp

from lumisplat.device.structs import struct


@struct
class SplatParameters:
    """Trained parameters of Gaussians in unbounded form, or Adam's moments of them; one element for each Gaussian."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.vec4]
    """Rotation quaternions, scalar first, of any length above 0; they are normalised before use."""
    log_scales: wp.array[wp.vec3]
    logits: wp.array[float]
    """Logits of the opacities: ``opacity = 1 / (1 + exp(-logit))``."""
    sh: wp.array[wp.vec3]
    """SH coefficients, ``sh_count`` consecutive elements for each Gaussian."""
    sh_count: int


@struct
class StepRates:
    """Holds the rates of Adam (Kingma and Ba 2015) and the noise with which one step updates Gaussians."""

    means: float
    rotations: float
    log_scales: float
    logits: float
    sh: float
    """Learning rate of the SH coefficients of degree 0; ``sh_rest``: of all others."""
    sh_rest: float
    sh_active: int
    """Number of SH coefficients per Gaussian that are trained by now; it grows with the active degree."""
    first_scale: float
    """Bias correction of the first moment, 1 / (1 - beta1^step); ``second_scale`` corrects the second moment."""
    second_scale: float
    by_opacity: float
    """Gradient that the opacity regulariser adds to each Gaussian's opacity; ``by_scale`` is added to scales by the
    scale regulariser."""
    by_scale: float
    noise: float
    """Factor of the random noise that MCMC adds to positions, a standard normal vector times the covariance (Kheradmand
    et al. 2024, eq. 9); opaque Gaussians get almost none."""
    iteration: int
    """Number of completed iterations, a key of the random numbers."""


@struct
class SplatRecord:
    """Statistics of each Gaussian since the last densification step."""

    motion: wp.array[float]
    """Sum over frames of |d loss / d image position| as in AbsGS, with the position in units of half the image size."""
    turns: wp.array[float]
    """Sum over frames of the length of a gradient: of the surface losses with respect to rotating the Gaussian's
    normal.

    Each term is multiplied by the summed pixel weights of the loss, so that it does not depend on the image size."""
    frames: wp.array[float]
    """Number of frames since the last densification step that showed the Gaussian."""
    stopped: wp.array[int]
    """Flag, one element: not 0 after a step that must be repeated; statistics and parameters then stay as they are."""


@struct
class TargetImage:
    """A training image on the device, one element for each pixel."""

    color: wp.array[wp.vec3]
    """Colour of the training image, display-referred sRGB; where it is transparent, composited over the background."""
    weight: wp.array[float]
    """Weight of each pixel in the loss, 0..1; empty: all pixels count fully."""
    alpha: wp.array[float]
    """Alpha that the rendered frame should have at each pixel; empty: the training image has no alpha."""


@struct
class LossGrid:
    """How loss kernels divide an image among threads: runs of adjacent pixels in a row."""

    width: int
    height: int
    run: int
    """Number of adjacent pixels of a row that one thread processes: a whole row on CPUs, one pixel on CUDA."""


@struct
class Exposure:
    """Exposure correction of a training image: a rendered colour becomes ``matrix * color + alpha * offset``."""

    matrix: wp.mat33
    offset: wp.vec3
    background: wp.vec3
    """Display-referred sRGB background behind the Gaussians; the correction is not applied to it."""


@struct
class SurfaceTerms:
    """Weights of the surface losses, divided by the sum of the pixel weights, and the encoding of depths in them."""

    normals: float
    depth: float
    smooth: float
    weight_sum: float
    """Sum of the pixel weights."""
    middle: float
    """View depth, scene units, at which the encoded depth ``(depth - middle) * per_unit`` is 0."""
    per_unit: float
    """Factor of the encoded depth ``(depth - middle) * per_unit``: 1 over the scene's extent."""


@struct
class SurfaceMaps:
    """For each pixel, the surface losses of normals and depths, and their derivatives."""

    terms: wp.array[wp.vec2]
    """Each pixel's term in the loss of normals (x) and in the loss of depths (y)."""
    across: wp.array[wp.vec3]
    """Derivative of the loss with respect to a vector: from the left neighbour's surface point to the right
    neighbour's.

    ``down`` is the derivative with respect to the vector from the upper to the lower neighbour's surface point.
    """
    down: wp.array[wp.vec3]
    alpha: wp.array[float]
    """d loss / d alpha of each pixel."""


@struct
class SmoothnessMaps:
    """For each pixel, the loss that keeps neighbouring normals similar, and its derivatives."""

    terms: wp.array[float]
    """Each pixel's term in the normal smoothness loss."""
    across: wp.array[wp.vec3]
    """d loss / d Sobel derivative of the normals along the row, at each pixel; ``down``: along the column."""
    down: wp.array[wp.vec3]


@struct
class LossMaps:
    """Images blurred by the SSIM window, later overwritten by derivatives; one element for each pixel."""

    shown: wp.array[wp.vec3]
    """Blurred rendered frame, then d loss / d blurred frame."""
    squared: wp.array[wp.vec3]
    """Blurred square of the rendered frame, then d loss / d blurred square."""
    product: wp.array[wp.vec3]
    """Blurred product of rendered frame and training image, then d loss / d blurred product."""
    target: wp.array[wp.vec3]
    """Blurred training image; ``target_squared``: its blurred square."""
    target_squared: wp.array[wp.vec3]


@struct
class LossWeights:
    """Weights of the image losses, divided by the sum of the pixel weights and, for colours, by 3 channels."""

    l1: float
    ssim: float
    alpha: float
    entropy: float


@struct
class GaussianMaterials:
    """Opaque materials to be fitted, one element for each Gaussian."""

    means: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    """Unit normals, towards the lit and visible side."""
    albedo: wp.array[wp.vec3]
    """Base colour, linear, 0..1."""
    roughness: wp.array[float]
    """Perceptual roughness, above 0, at most 1."""
    metallic: float
    """Metalness of all Gaussians: 0 for dielectrics, 1 for metals, whose reflectance is the albedo."""


@struct
class DirectionalLight:
    """Light that arrives at each of N Gaussians from each of K directions; the directions sample the sphere evenly."""

    directions: wp.array[wp.vec3]
    """Unit directions towards the light, one for each of K directions."""
    solid_angle: float
    """Solid angle that each direction stands for, steradians."""
    environment: wp.array[wp.vec3]
    """Environment radiance from each of K directions, linear."""
    open: wp.array2d[float]
    """Fraction, 0..1, of the environment's light from direction k that reaches Gaussian i unblocked, shape (N, K)."""
    seen: wp.array2d[wp.vec3]
    """Linear radiance of the surfaces that block the environment from Gaussian i in direction k, shape (N, K).

    It is 0 where nothing blocks."""
    spread: float
    """Value added to the squared GGX alpha of highlights, so that they are wider than the spacing of the directions."""


@struct
class MaterialGradient:
    """Gradients of a loss with respect to materials, one element for each Gaussian."""

    albedo: wp.array[wp.vec3]
    roughness: wp.array[float]
    normals: wp.array[wp.vec3]
    """d loss / d normal of each Gaussian, the normal taken as a vector of any length."""


# --- Weights of pixels, and incident light ---


@wp.func
def pixel_weight(target: TargetImage, i: int) -> float:
    """Returns the weight of a pixel in the loss, 0..1."""
    if target.weight.shape[0] > 0:
        return target.weight[i]
    return 1.0


@wp.func
def masked_color(shown: wp.vec3, target: TargetImage, i: int) -> wp.vec3:
    """Returns ``w * shown + (1 - w) * target`` of a pixel, where w is the pixel's weight in the loss."""
    return wp.lerp(target.color[i], shown, pixel_weight(target, i))


@wp.func
def incident_radiance(light: DirectionalLight, i: int, k: int) -> wp.vec3:
    """Returns the linear radiance that reaches Gaussian ``i`` from direction ``k``: environment plus surfaces."""
    return light.open[i, k] * light.environment[k] + light.seen[i, k]
