"""Shading of Gaussians by incident radiance, and gradients of their colours.

The equations are in docs/method/relightable.md.
"""

import warp as wp

from lumisplat.constants import ENVIRONMENT_CHUNK, SH_C0
from lumisplat.device.camera.pixels import is_listed
from lumisplat.device.material.microfacets import opaque_eval
from lumisplat.device.math.color import encode_srgb
from lumisplat.device.math.directions import flipped_to_front
from lumisplat.device.structs.gradients import SplatGradient
from lumisplat.device.structs.raster import TileRect
from lumisplat.device.training import DirectionalLight, GaussianMaterials, incident_radiance

wp.set_module_options({"enable_backward": False})

CHUNK = wp.constant(ENVIRONMENT_CHUNK)
SH_CONSTANT = wp.constant(wp.float32(SH_C0))


@wp.func
def srgb_derivative(linear: float) -> float:
    """Returns the derivative of the sRGB encoding at a linear value."""
    if linear <= 0.0031308:
        return 12.92
    return (1.055 / 2.4) * wp.pow(linear, 1.0 / 2.4 - 1.0)


@wp.kernel
def shade(
    start: int,
    eye: wp.vec3,
    materials: GaussianMaterials,
    light: DirectionalLight,
    radiance_out: wp.array[wp.vec3],
    sh_out: wp.array[wp.vec3],
):
    """Computes the radiance towards the eye, and its display value as SH of degree 0. One thread per Gaussian."""
    i = start + wp.tid()
    normal = materials.normals[i]
    albedo = materials.albedo[i]
    roughness = materials.roughness[i]
    metallic = materials.metallic
    view = flipped_to_front(wp.normalize(eye - materials.means[i]), normal)
    radiance = wp.vec3(0.0)
    for k in range(light.directions.shape[0]):
        direction = light.directions[k]
        cosine = wp.dot(normal, direction)
        if cosine > 0.0:
            arriving = (cosine * light.solid_angle) * incident_radiance(light, i, k)
            reflected = opaque_eval(normal, albedo, roughness, metallic, view, direction, light.spread)
            radiance += wp.cw_mul(reflected, arriving)
    radiance_out[i] = radiance
    shown = wp.vec3(
        encode_srgb(wp.min(radiance[0], 1.0)),
        encode_srgb(wp.min(radiance[1], 1.0)),
        encode_srgb(wp.min(radiance[2], 1.0)),
    )
    sh_out[i] = (shown - wp.vec3(0.5)) / SH_CONSTANT


@wp.kernel
def decode_gradients(
    start: int,
    rects: wp.array[TileRect],
    by_splats: wp.array[SplatGradient],
    radiance: wp.array[wp.vec3],
    by_radiance_out: wp.array[wp.vec3],
):
    """Computes the gradient of a Gaussian's linear radiance from that of its display colour. One thread per Gaussian.

    The display clips radiance above white, so the gradient of such radiance is dropped unless it darkens.
    """
    i = start + wp.tid()
    by_radiance = wp.vec3(0.0)
    if is_listed(rects[i]):
        by_color = by_splats[i].color
        for c in range(3):
            if radiance[i][c] < 1.0 or by_color[c] > 0.0:
                by_radiance[c] = by_color[c] * srgb_derivative(radiance[i][c])
    by_radiance_out[i] = by_radiance


@wp.kernel
def differentiate_environment(
    start: int,
    eye: wp.vec3,
    materials: GaussianMaterials,
    light: DirectionalLight,
    by_radiance: wp.array[wp.vec3],
    by_environment_out: wp.array2d[wp.vec3],
):
    """Sums the gradient with respect to the environment's radiance over a chunk of Gaussians. One thread per chunk."""
    chunk = start + wp.tid()
    directions = light.directions.shape[0]
    for k in range(directions):
        by_environment_out[chunk, k] = wp.vec3(0.0)
    for i in range(chunk * CHUNK, wp.min((chunk + 1) * CHUNK, by_radiance.shape[0])):
        given = by_radiance[i]
        if wp.dot(given, given) > 0.0:
            normal = materials.normals[i]
            albedo = materials.albedo[i]
            roughness = materials.roughness[i]
            metallic = materials.metallic
            view = flipped_to_front(wp.normalize(eye - materials.means[i]), normal)
            for k in range(directions):
                direction = light.directions[k]
                cosine = wp.dot(normal, direction)
                if cosine > 0.0:
                    share = cosine * light.solid_angle * light.open[i, k]
                    reflected = opaque_eval(normal, albedo, roughness, metallic, view, direction, light.spread)
                    by_environment_out[chunk, k] = by_environment_out[chunk, k] + share * wp.cw_mul(given, reflected)
