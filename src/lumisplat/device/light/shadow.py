"""Attenuation of light by the surfaces and Gaussians on a shadow ray (docs/method/shadows.md)."""

import warp as wp

from lumisplat.device.material.fresnel import fresnel
from lumisplat.device.math.color import decode_srgb_color
from lumisplat.device.math.random import sample_key_of, sobol_2d
from lumisplat.device.math.sh import sh_color
from lumisplat.device.structs.bvh import DRAWS_NONE, DRAWS_PER_RAY, DRAWS_SHARED, ShadowData
from lumisplat.device.structs.scene import GaussianData, SmoothData

wp.set_module_options({"enable_backward": False})


@wp.func
def shadow_key(settings: ShadowData) -> wp.uint32:
    """Key of the random numbers that all rays of a stochastic sample share."""
    return sample_key_of(-1, settings.sample // 16, settings.seed)


@wp.func
def shadow_floor(settings: ShadowData, pixel_key: wp.uint32, sample: int) -> float:
    """Transmittance down to which a ray is followed: where it counts as black; by a number a ray, that number."""
    if settings.draws == DRAWS_PER_RAY:
        return sobol_2d(pixel_key, sample)[0]
    if settings.draws == DRAWS_SHARED:
        return 0.0
    return wp.max(settings.transmittance_min, settings.threshold)


@wp.func
def passed_share(settings: ShadowData, transmittance: float) -> float:
    """The transmittance of a ray that came through; 1 or 0 if it was blocked wholly or not at all."""
    if settings.draws == DRAWS_NONE:
        return transmittance
    return wp.where(transmittance > 0.0, 1.0, 0.0)


@wp.func
def pass_straight(material: SmoothData, base_color: wp.vec3, cosine: float) -> wp.vec3:
    """Share of light that crosses a surface, linear; 0 unless it is smooth and transmits.

    The ray goes straight on, without refraction. Both sides therefore count as air: light that leaves the mesh has the
    Fresnel reflectance of light that enters it, and total internal reflection does not occur.
    """
    if material.smooth == 0:
        return wp.vec3(0.0)
    mirrored = material.specular * fresnel(cosine, 1.0 / material.ior)
    return (1.0 - mirrored) * (1.0 - material.metallic) * material.transmission * base_color


@wp.func
def tint_of(gaussians: GaussianData, i: int) -> wp.vec3:
    """Linear, view-independent colour of Gaussian ``i``: its SH of degree 0."""
    return decode_srgb_color(sh_color(gaussians.sh, i * gaussians.sh_count, 0, wp.vec3(0.0)))


@wp.func
def shadow_of(settings: ShadowData, transmittance: float, tint: wp.vec3) -> wp.vec3:
    """Visibility of a light through Gaussians: the factor of each channel.

    Args:
        settings: Threshold and strength.
        transmittance: Of all of them.
        tint: Sum of their linear colours, weighted by alpha; its scale is irrelevant.
    """
    if transmittance <= wp.max(settings.transmittance_min, settings.threshold):
        return wp.vec3(0.0)
    bright = wp.min((transmittance - settings.threshold) / (1.0 - settings.threshold), 1.0)
    share = wp.min(settings.color_strength * (1.0 - bright), 1.0)
    largest = wp.max(tint)
    if share <= 0.0 or largest <= 0.0:
        return wp.vec3(bright)
    return bright * wp.lerp(wp.vec3(1.0), tint / largest, share)
