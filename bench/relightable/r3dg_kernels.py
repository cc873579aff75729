"""Gaussians lit by the formulas of Relightable 3D Gaussians (Gao et al. 2024), and derivatives of what they show.

An item is a Gaussian with S directions of its own. Their microfacet term: GGX, Schlick's masking with (r + 1)^2 / 8,
and 0.04 + 0.96 * 2^(-5.55473 c^2 - 6.98316 c) for Fresnel's.
"""

import warp as wp

from lumisplat.constants import SH_C0
from lumisplat.device.camera.pixels import is_listed
from lumisplat.device.math.color import encode_srgb
from lumisplat.device.structs.gradients import SplatGradient
from lumisplat.device.structs.raster import TileRect
from lumisplat.training.materials.material_kernels import slope_of_encoding

wp.set_module_options({"enable_backward": False})

HARMONIC = wp.constant(wp.float32(SH_C0))
INV_PI = wp.constant(wp.float32(0.3183098861837907))
LEAST = wp.constant(wp.float32(1e-6))
COEFFICIENTS = wp.constant(16)


@wp.struct
class R3dgLight:
    """What reaches N Gaussians from S directions each."""

    directions: wp.array2d[wp.vec3]
    """Unit, towards the light, shape (N, S)."""
    area: float
    """Of the hemisphere that each stands for, steradians."""
    harmonics: wp.array3d[float]
    """Of the directions, shape (N, S, 16)."""
    sky: wp.array2d[wp.vec3]
    """What comes from the sky, as far as it is visible, shape (N, S)."""
    local: wp.array2d[wp.vec3]
    """Harmonics of what comes from near by, shape (N, 16)."""


@wp.struct
class R3dgMaterials:
    """What they are made of."""

    means: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]
    roughness: wp.array[float]


@wp.struct
class R3dgGradient:
    """Derivatives of a loss, in place of what they are by; of the sky, sample by sample."""

    albedo: wp.array[wp.vec3]
    roughness: wp.array[float]
    local: wp.array2d[wp.vec3]
    sky: wp.array2d[wp.vec3]


@wp.func
def positive(cosine: float) -> float:
    """At least 1e-6, at most 1."""
    return wp.clamp(cosine, LEAST, 1.0)


@wp.func
def highlight(normal: wp.vec3, view: wp.vec3, light: wp.vec3, roughness: float) -> wp.vec2:
    """Their microfacet term, and its derivative by roughness."""
    side = normal
    if wp.dot(view, normal) < 0.0:
        side = -normal
    half = wp.normalize(view + light)
    n_v = positive(wp.dot(side, view))
    n_l = positive(wp.dot(side, light))
    n_h = positive(wp.dot(side, half))
    v_h = positive(wp.dot(view, half))
    alpha_squared = roughness * roughness * roughness * roughness
    k = (roughness + 1.0) * (roughness + 1.0) / 8.0
    fresnel = 0.04 + 0.96 * wp.pow(2.0, (-5.55473 * v_h - 6.98316) * v_h)
    peak = n_h * n_h * (alpha_squared - 1.0) + 1.0
    mask_v = n_v * (1.0 - k) + k
    mask_l = n_l * (1.0 - k) + k
    below = 4.0 * wp.pi * peak * peak * mask_v * mask_l
    of_logarithm = 4.0 / roughness
    if below > LEAST and below < 4.0 * wp.pi:
        by_k = (1.0 - n_v) / mask_v + (1.0 - n_l) / mask_l
        of_logarithm -= 8.0 * roughness * roughness * roughness * n_h * n_h / peak + 0.25 * (roughness + 1.0) * by_k
    value = fresnel * alpha_squared / wp.clamp(below, LEAST, 4.0 * wp.pi)
    return wp.vec2(value, value * of_logarithm)


@wp.func
def local_light(light: R3dgLight, i: int, s: int) -> wp.vec3:
    """What the harmonics of a Gaussian are in one of its directions, of any sign."""
    total = wp.vec3(0.0)
    for k in range(COEFFICIENTS):
        total += light.harmonics[i, s, k] * light.local[i, k]
    return total


@wp.func
def nonnegative(value: wp.vec3) -> wp.vec3:
    """At least 0, channel by channel."""
    return wp.vec3(wp.max(value[0], 0.0), wp.max(value[1], 0.0), wp.max(value[2], 0.0))


@wp.kernel
def shade(
    start: int,
    eye: wp.vec3,
    materials: R3dgMaterials,
    light: R3dgLight,
    diffuse_light_out: wp.array[wp.vec3],
    sh_out: wp.array[wp.vec3],
):
    """Item = Gaussian: the mean over its directions of reflected light, as a colour that is blended as it is."""
    i = start + wp.tid()
    normal = materials.normals[i]
    view = wp.normalize(eye - materials.means[i])
    radiance = wp.vec3(0.0)
    diffuse_light = wp.vec3(0.0)
    count = light.directions.shape[1]
    for s in range(count):
        way = light.directions[i, s]
        cosine = wp.max(wp.dot(normal, way), 0.0)
        arriving = light.sky[i, s] + nonnegative(local_light(light, i, s))
        transport = (cosine * light.area / float(count)) * arriving
        shine = highlight(normal, view, way, materials.roughness[i])
        radiance += wp.cw_mul(materials.albedo[i] * INV_PI + wp.vec3(shine[0]), transport)
        diffuse_light += transport
    diffuse_light_out[i] = diffuse_light
    sh_out[i] = (radiance - wp.vec3(0.5)) / HARMONIC


@wp.kernel
def differentiate(
    start: int,
    eye: wp.vec3,
    materials: R3dgMaterials,
    light: R3dgLight,
    rects: wp.array[TileRect],
    by_splats: wp.array[SplatGradient],
    by_diffuse_light: wp.array[wp.vec3],
    gradient_out: R3dgGradient,
):
    """Item = Gaussian: derivatives by all that it is lit by and made of."""
    i = start + wp.tid()
    by_radiance = wp.vec3(0.0)
    if is_listed(rects[i]):
        by_radiance = by_splats[i].color
    normal = materials.normals[i]
    view = wp.normalize(eye - materials.means[i])
    by_albedo = wp.vec3(0.0)
    by_roughness = float(0.0)
    for k in range(COEFFICIENTS):
        gradient_out.local[i, k] = wp.vec3(0.0)
    count = light.directions.shape[1]
    for s in range(count):
        way = light.directions[i, s]
        share = wp.max(wp.dot(normal, way), 0.0) * light.area / float(count)
        near = local_light(light, i, s)
        transport = share * (light.sky[i, s] + nonnegative(near))
        shine = highlight(normal, view, way, materials.roughness[i])
        by_albedo += INV_PI * wp.cw_mul(by_radiance, transport)
        by_roughness += shine[1] * wp.dot(by_radiance, transport)
        reflected = materials.albedo[i] * INV_PI + wp.vec3(shine[0])
        by_light = share * (wp.cw_mul(reflected, by_radiance) + by_diffuse_light[i])
        gradient_out.sky[i, s] = by_light
        for c in range(3):
            if near[c] < 0.0:
                by_light[c] = 0.0
        for k in range(COEFFICIENTS):
            gradient_out.local[i, k] = gradient_out.local[i, k] + light.harmonics[i, s, k] * by_light
    gradient_out.albedo[i] = by_albedo
    gradient_out.roughness[i] = by_roughness


@wp.kernel
def encode_pixels(start: int, linear: wp.array[wp.vec3], encoded_out: wp.array[wp.vec3]):
    """Item = pixel: its colour as displays show it."""
    i = start + wp.tid()
    value = linear[i]
    encoded_out[i] = wp.vec3(
        encode_srgb(wp.clamp(value[0], 0.0, 1.0)),
        encode_srgb(wp.clamp(value[1], 0.0, 1.0)),
        encode_srgb(wp.clamp(value[2], 0.0, 1.0)),
    )


@wp.kernel
def decode_gradients(start: int, linear: wp.array[wp.vec3], by_color_inout: wp.array[wp.vec3]):
    """Item = pixel: derivatives by its linear colour; beyond what displays show there are none."""
    i = start + wp.tid()
    by_linear = wp.vec3(0.0)
    for c in range(3):
        if linear[i][c] >= 0.0 and linear[i][c] <= 1.0:
            by_linear[c] = by_color_inout[i][c] * slope_of_encoding(linear[i][c])
    by_color_inout[i] = by_linear
