"""Structs of training: parameters, optimiser steps, losses and images; and the weights of pixels."""

import warp as wp

from lumisplat.device.structs import struct


@struct
class SplatParameters:
    """Trained parameters of Gaussians in unbounded form, or their optimiser moments; one element for each Gaussian."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.vec4]
    """Quaternions wxyz of any length above 0."""
    log_scales: wp.array[wp.vec3]
    logits: wp.array[float]
    """Logits of the opacities."""
    sh: wp.array[wp.vec3]
    """SH coefficients, ``sh_count`` consecutive elements for each Gaussian."""
    sh_count: int


@struct
class StepRates:
    """Step sizes and factors of one Adam step (Kingma and Ba 2015)."""

    means: float
    rotations: float
    log_scales: float
    logits: float
    sh: float
    """Step size of the SH coefficient of degree 0."""
    sh_rest: float
    sh_active: int
    """Number of SH coefficients trained so far."""
    first_scale: float
    """Bias correction of the first moment, 1 / (1 - beta1^step); ``second_scale`` corrects the second moment."""
    second_scale: float
    by_opacity: float
    """Derivative of the opacity regulariser with respect to each opacity; ``by_scale``: of the scale regulariser."""
    by_scale: float


@struct
class NoiseData:
    """Exploration noise added to positions (Kheradmand et al. 2024, equation 9)."""

    strength: float
    """Factor of the noise, which is a standard normal vector times the covariance; it applies to transparent
    Gaussians."""
    iteration: int
    seed: wp.uint32


@struct
class SplatRecord:
    """Statistics of each Gaussian collected between two densification steps."""

    motion: wp.array[float]
    """Sum over frames of the magnitude of the loss gradient by the splat's image position, in units of half the image
    size.
    """
    turns: wp.array[float]
    """Sum over frames of the gradient of the surface losses by rotation of the Gaussian's normal.

    Each term is multiplied by the number of pixels that the losses count."""
    frames: wp.array[float]
    """Number of frames that showed the Gaussian."""


@struct
class TargetImage:
    """A training image on the device, one element for each pixel."""

    color: wp.array[wp.vec3]
    """Display-referred sRGB, composited over the background where it is transparent."""
    weight: wp.array[float]
    """Weight of each pixel in the loss, 0..1; empty: all pixels count fully."""
    alpha: wp.array[float]
    """Alpha that the frame is to have; empty: unknown."""


@struct
class LossGrid:
    """Division of an image's pixels among the threads of loss kernels."""

    width: int
    height: int
    run: int
    """Adjacent pixels of a row that one thread processes."""


@struct
class Exposure:
    """Exposure of a training image: rendered colours are mapped to ``matrix * color + alpha * offset``."""

    matrix: wp.mat33
    offset: wp.vec3
    background: wp.vec3
    """Display-referred sRGB behind the Gaussians, which is not mapped."""


@struct
class SurfaceTerms:
    """Weights of the surface losses, each normalised by the number of pixels."""

    normals: float
    depth: float
    middle: float
    """View depth that the depth feature encodes as 0, scene units."""
    per_unit: float
    """Change of the depth feature for one scene unit of view depth."""


@struct
class SurfaceMaps:
    """Surface losses of a frame and their derivatives, one element for each pixel."""

    terms: wp.array[wp.vec2]
    """Loss terms of normals and of depths."""
    across: wp.array[wp.vec3]
    """Derivatives with respect to the vector from the left to the right neighbour's surface point.

    ``down`` has the derivatives with respect to the vector from the upper to the lower neighbour's surface point.
    """
    down: wp.array[wp.vec3]
    alpha: wp.array[float]
    """Derivatives with respect to alpha."""


@struct
class SmoothnessMaps:
    """Normal smoothness losses of a frame and their derivatives, one element for each pixel."""

    terms: wp.array[float]
    """Loss terms."""
    across: wp.array[wp.vec3]
    """Derivatives with respect to the difference of normals between pixels of a row; ``down``: of a column."""
    down: wp.array[wp.vec3]


@struct
class LossMaps:
    """Blurred maps of the SSIM loss, one element for each pixel."""

    shown: wp.array[wp.vec3]
    """Blurred frame; later the derivatives with respect to the frame's local mean."""
    squared: wp.array[wp.vec3]
    """Blurred squares of the frame; later the derivatives with respect to the blurred squares."""
    product: wp.array[wp.vec3]
    """Blurred products of frame and training image; later the derivatives with respect to the blurred products."""
    target: wp.array[wp.vec3]
    """Blurred training image."""
    target_squared: wp.array[wp.vec3]


@struct
class LossWeights:
    """Weights of the image losses, each normalised by the number of pixel channels."""

    l1: float
    ssim: float
    alpha: float
    entropy: float


@struct
class GaussianMaterials:
    """Dielectric materials of Gaussians, one element for each Gaussian."""

    means: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    """Unit normals, towards the lit and visible side."""
    albedo: wp.array[wp.vec3]
    """Base colour, linear, 0..1."""
    roughness: wp.array[float]
    """Perceptual roughness, above 0, at most 1."""


@struct
class DirectionalLight:
    """Incident light on N Gaussians from K directions that sample the sphere, each standing for a solid angle."""

    directions: wp.array[wp.vec3]
    """Unit directions towards the light, one for each of K directions."""
    solid_angle: float
    """Solid angle that each direction stands for, steradians."""
    environment: wp.array[wp.vec3]
    """Environment radiance from each of K directions, linear."""
    open: wp.array2d[float]
    """Fraction, 0..1, of the environment's light from each of K directions that reaches each of N Gaussians, shape (N,
    K)."""
    seen: wp.array2d[wp.vec3]
    """Indirect radiance from each of K directions at each of N Gaussians, linear, shape (N, K).

    It is the light of surfaces that block the environment."""
    spread: float
    """Value added to the squared GGX alpha of highlights, so that they are wider than the spacing of the directions."""


@struct
class MaterialGradient:
    """Gradients of a loss with respect to materials, one element for each Gaussian."""

    albedo: wp.array[wp.vec3]
    roughness: wp.array[float]
    normals: wp.array[wp.vec3]
    """Gradient with respect to the normal as a vector of any length."""


# --- Weights of pixels, and incident light ---


@wp.func
def pixel_weight(target: TargetImage, i: int) -> float:
    """Returns the weight of a pixel in the loss, 0..1."""
    if target.weight.shape[0] > 0:
        return target.weight[i]
    return 1.0


@wp.func
def masked_color(shown: wp.vec3, target: TargetImage, i: int) -> wp.vec3:
    """Returns the rendered colour where the pixel counts, blended to the target colour where it does not."""
    return wp.lerp(target.color[i], shown, pixel_weight(target, i))


@wp.func
def incident_radiance(light: DirectionalLight, i: int, k: int) -> wp.vec3:
    """Returns the radiance that reaches Gaussian ``i`` from direction ``k``."""
    return light.open[i, k] * light.environment[k] + light.seen[i, k]
