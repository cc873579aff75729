"""Data of training: parameters, steps, losses and images, and how much of an image counts."""

import warp as wp

from lumisplat.device.structs import struct


@struct
class SplatParameters:
    """Parameters of Gaussians as they are learnt, unbounded; or their moments. An element a Gaussian."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.vec4]
    """Quaternions wxyz of any length above 0."""
    log_scales: wp.array[wp.vec3]
    logits: wp.array[float]
    """Of opacities."""
    sh: wp.array[wp.vec3]
    """``sh_count`` consecutive ones a Gaussian."""
    sh_count: int


@struct
class StepRates:
    """How far parameters move in one step (Adam, Kingma and Ba 2015)."""

    means: float
    rotations: float
    log_scales: float
    logits: float
    sh: float
    """Of the constant harmonic."""
    sh_rest: float
    sh_active: int
    """Coefficients that are learnt by now."""
    first_scale: float
    """1 / (1 - beta1^step): undoes the bias of the first moment; likewise ``second_scale``."""
    second_scale: float
    by_opacity: float
    """Derivative of the loss by each opacity besides that of pixels; likewise ``by_scale``."""
    by_scale: float


@struct
class NoiseData:
    """Noise that explores (Kheradmand et al. 2024, equation 9)."""

    strength: float
    """Times the covariance and a standard normal vector, for transparent Gaussians."""
    iteration: int
    seed: wp.uint32


@struct
class SplatRecord:
    """What is noted of each Gaussian between two changes of their number."""

    motion: wp.array[float]
    """Sum over frames of how strongly the loss pulls at its splat, in halves of the image."""
    turns: wp.array[float]
    """Sum over frames of how strongly terms on surfaces turn its normal: their derivative, times pixels that count."""
    frames: wp.array[float]
    """In how many of them it was drawn."""


@struct
class TargetImage:
    """A photograph on the device, an element a pixel."""

    color: wp.array[wp.vec3]
    """Display-referred sRGB, over the background where it is transparent."""
    weight: wp.array[float]
    """0..1: what counts; without elements: all does."""
    alpha: wp.array[float]
    """What the frame's alpha should be; without elements: nobody knows."""


@struct
class LossGrid:
    """How the pixels of a picture are shared out."""

    width: int
    height: int
    run: int
    """Neighbours in a row that are one item."""


@struct
class Exposure:
    """How a photograph was exposed: what Gaussians show is mapped as ``matrix * color + alpha * offset``."""

    matrix: wp.mat33
    offset: wp.vec3
    background: wp.vec3
    """Display-referred sRGB behind the Gaussians, which stays as it is."""


@struct
class SurfaceTerms:
    """What counts how much on the surfaces of a frame; each is a share of a pixel."""

    normals: float
    depth: float
    middle: float
    """View depth that is 0 as a feature, scene units."""
    per_unit: float
    """Of features, in a scene unit."""


@struct
class SurfaceMaps:
    """What a frame's surfaces say, an element a pixel."""

    terms: wp.array[wp.vec2]
    """Of the loss: of normals, and of depths."""
    across: wp.array[wp.vec3]
    """Derivatives by the vector from the surface to the left to that to the right; likewise ``down``."""
    down: wp.array[wp.vec3]
    alpha: wp.array[float]
    """Derivatives by alpha."""


@struct
class SmoothnessMaps:
    """How normals change over a frame, an element a pixel."""

    terms: wp.array[float]
    """Of the loss."""
    across: wp.array[wp.vec3]
    """Derivatives by the difference along the row; likewise ``down``."""
    down: wp.array[wp.vec3]


@struct
class LossMaps:
    """Blurred maps, an element a pixel."""

    shown: wp.array[wp.vec3]
    """Of the frame; then of the derivatives by its mean."""
    squared: wp.array[wp.vec3]
    """Of its squares; then of the derivatives by these."""
    product: wp.array[wp.vec3]
    """Of its products with the photograph; then of the derivatives by these."""
    target: wp.array[wp.vec3]
    """Of the photograph."""
    target_squared: wp.array[wp.vec3]


@struct
class LossWeights:
    """What counts how much; each is a share of a pixel's channel."""

    l1: float
    ssim: float
    alpha: float
    entropy: float


@struct
class GaussianMaterials:
    """What Gaussians are made of, none of it metal; an element a Gaussian."""

    means: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    """Unit, towards the side that is lit and seen."""
    albedo: wp.array[wp.vec3]
    """Base colour, linear, 0..1."""
    roughness: wp.array[float]
    """Perceptual, above 0, at most 1."""


@struct
class DirectionalLight:
    """Light on N Gaussians from K directions that stand for the sphere, each with its share of it."""

    directions: wp.array[wp.vec3]
    """Unit, towards the light, shape (K,)."""
    solid_angle: float
    """Of each, steradians."""
    sky: wp.array[wp.vec3]
    """Radiance of the surroundings around each direction, linear, shape (K,)."""
    open: wp.array2d[float]
    """Share of the sky that reaches a Gaussian, 0..1, shape (N, K)."""
    seen: wp.array2d[wp.vec3]
    """Radiance of what blocks the rest, linear, shape (N, K)."""
    spread: float
    """What adds to the squared alpha of highlights, so that they are wider than directions are apart."""


@struct
class MaterialGradient:
    """Derivatives of a loss by materials; an element a Gaussian."""

    albedo: wp.array[wp.vec3]
    roughness: wp.array[float]
    normals: wp.array[wp.vec3]
    """As of a vector of any length."""


# --- How much of an image counts ---


@wp.func
def pixel_weight(target: TargetImage, i: int) -> float:
    """How much a pixel counts, 0..1."""
    if target.weight.shape[0] > 0:
        return target.weight[i]
    return 1.0


@wp.func
def masked_color(shown: wp.vec3, target: TargetImage, i: int) -> wp.vec3:
    """What a frame shows where it counts, the target elsewhere."""
    return wp.lerp(target.color[i], shown, pixel_weight(target, i))


@wp.func
def incident_radiance(light: DirectionalLight, i: int, k: int) -> wp.vec3:
    """Radiance that reaches Gaussian ``i`` from direction ``k``."""
    return light.open[i, k] * light.sky[k] + light.seen[i, k]
