"""Kernels that run device functions of lights and materials for many inputs, for their tests."""

import warp as wp

from lumisplat.device.gi.surfaces import diffuse_albedo, glossy_albedo, transmitted_albedo
from lumisplat.device.light.emitters import environment_pdf, environment_radiance, sample_environment
from lumisplat.device.light.interaction import bsdf_of
from lumisplat.device.light.light import light_crossing, sample_light
from lumisplat.device.material.bsdf import BsdfSample, bsdf_eval, bsdf_pdf, bsdf_sample
from lumisplat.device.structs.shading import Bsdf, EnvironmentData, LightCrossing, LightData, LightSample, MaterialData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_bsdf(
    bsdfs: wp.array(dtype=Bsdf),
    normals: wp.array(dtype=wp.vec3),
    views: wp.array(dtype=wp.vec3),
    lights: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.vec3),
    densities: wp.array(dtype=float),
):
    """Evaluates BSDFs and pdfs for pairs of directions."""
    i = wp.tid()
    values[i] = bsdf_eval(bsdfs[i], normals[i], views[i], lights[i])
    densities[i] = bsdf_pdf(bsdfs[i], normals[i], views[i], lights[i])


@wp.kernel
def probe_bsdf_samples(
    bsdfs: wp.array(dtype=Bsdf),
    normals: wp.array(dtype=wp.vec3),
    views: wp.array(dtype=wp.vec3),
    randoms: wp.array(dtype=wp.vec3),
    samples: wp.array(dtype=BsdfSample),
):
    """Samples directions of BSDFs."""
    i = wp.tid()
    u = randoms[i]
    samples[i] = bsdf_sample(bsdfs[i], normals[i], views[i], wp.vec2(u[0], u[1]), u[2])


@wp.kernel
def probe_albedos(
    bsdfs: wp.array(dtype=Bsdf), cosines: wp.array(dtype=float), albedos: wp.array(dtype=wp.vec3, ndim=2)
):
    """Evaluates diffuse, glossy and transmitted albedo for cosines of the view."""
    i = wp.tid()
    albedos[i, 0] = diffuse_albedo(bsdfs[i], cosines[i])
    albedos[i, 1] = glossy_albedo(bsdfs[i], cosines[i])
    albedos[i, 2] = transmitted_albedo(bsdfs[i], cosines[i])


@wp.kernel
def probe_lights(
    lights: wp.array(dtype=LightData),
    points: wp.array(dtype=wp.vec3),
    soft: int,
    randoms: wp.array(dtype=wp.vec2),
    samples: wp.array(dtype=LightSample),
):
    """Samples lights from points."""
    i = wp.tid()
    samples[i] = sample_light(lights[i], points[i], soft, randoms[i])


@wp.kernel
def probe_crossings(
    light: wp.array(dtype=LightData),
    origin: wp.vec3,
    directions: wp.array(dtype=wp.vec3),
    crossings: wp.array(dtype=LightCrossing),
):
    """Intersects rays from a point with a light."""
    i = wp.tid()
    crossings[i] = light_crossing(light[0], origin, directions[i])


@wp.kernel
def probe_environment(
    environment: EnvironmentData,
    directions: wp.array(dtype=wp.vec3),
    radiances: wp.array(dtype=wp.vec3),
    densities: wp.array(dtype=float),
):
    """Evaluates the environment's radiance and pdf for directions."""
    i = wp.tid()
    radiances[i] = environment_radiance(environment, directions[i])
    densities[i] = environment_pdf(environment, directions[i])


@wp.kernel
def probe_environment_samples(
    environment: EnvironmentData, randoms: wp.array(dtype=wp.vec2), samples: wp.array(dtype=LightSample)
):
    """Samples directions of the environment."""
    i = wp.tid()
    samples[i] = sample_environment(environment, randoms[i])


@wp.kernel
def probe_material(
    materials: wp.array(dtype=MaterialData),
    color: wp.vec3,
    inside: bool,
    bsdfs: wp.array(dtype=Bsdf),
):
    """Makes the BSDFs of materials without textures."""
    i = wp.tid()
    own = materials[i]
    eta = wp.where(inside and own.transmission > 0.0, own.ior, 1.0 / own.ior)
    bsdfs[i] = bsdf_of(materials, i, color, own.roughness, own.metallic, own.transmission, eta)
