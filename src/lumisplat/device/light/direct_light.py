"""What a light adds to a ray's colour by way of a surface, if nothing is in the way (docs/method/lighting.md)."""

import warp as wp

from lumisplat.device.light.environment import environment_density, environment_radiance, sample_environment
from lumisplat.device.light.light import sample_light
from lumisplat.device.material.bsdf import bsdf_eval, bsdf_pdf, bsdf_sample
from lumisplat.device.math.color import is_black
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.structs.light import LightSample
from lumisplat.device.structs.shading import Contribution, Interaction, ShadingScene

wp.set_module_options({"enable_backward": False})

LIGHT_BRANCHES = wp.constant(2)
"""Strands of lights come after those of the reflected and the refracted ray."""


@wp.func
def arriving(point: Interaction, sample: LightSample) -> wp.vec3:
    """Irradiance of a surface by a sample of a light, if nothing is in the way."""
    cosine = wp.dot(point.normal, sample.direction)
    if cosine <= 0.0 or wp.dot(point.side, sample.direction) <= 0.0:
        return wp.vec3(0.0)
    return cosine * sample.irradiance


@wp.func
def by_way_of(point: Interaction, sample: LightSample, share: float) -> Contribution:
    """What ``share`` of a sample adds to the ray's colour; of a surface that is only darkened, what arrives there."""
    irradiance = share * arriving(point, sample)
    result = Contribution()
    if is_black(irradiance):
        return result
    result.direction = sample.direction
    result.distance = sample.distance
    result.color = irradiance
    if point.shadow_only == 0:
        reflectance = bsdf_eval(point.bsdf, point.normal, point.view, sample.direction)
        result.color = point.scale * wp.cw_mul(reflectance, irradiance)
    return result


@wp.func
def light_key(pixel_key: wp.uint32, number: int) -> wp.uint32:
    """Of the sequence that picks points of light ``number``."""
    return branch_key(pixel_key, LIGHT_BRANCHES + number)


@wp.func
def from_center(number: int, point: Interaction, scene: wp.array(dtype=ShadingScene)) -> Contribution:
    """What light ``number``, which is not the environment, adds by way of a surface, all of it at its centre."""
    sample = sample_light(scene[0].lights[number], point.position, 0, wp.vec2(0.5))
    return by_way_of(point, sample, 1.0)


@wp.func
def from_extent(
    number: int, point: Interaction, pixel_key: wp.uint32, scene: wp.array(dtype=ShadingScene)
) -> Contribution:
    """The same, by a point that chance picks on it."""
    u = sobol_2d(light_key(pixel_key, number), scene[0].settings[0].sample)
    sample = sample_light(scene[0].lights[number], point.position, 1, u)
    return by_way_of(point, sample, 1.0)


@wp.func
def from_environment(
    number: int, picks_bsdf: bool, point: Interaction, pixel_key: wp.uint32, scene: wp.array(dtype=ShadingScene)
) -> Contribution:
    """What the environment, light ``number``, adds by way of a surface, where its brightness or the BSDF sends a look.

    With the balance heuristic (Veach and Guibas 1995), both ways together see all of it once.
    """
    sample = LightSample()
    environment = scene[0].environment
    key = light_key(pixel_key, number)
    turn = scene[0].settings[0].sample
    if picks_bsdf:
        u = sobol_2d(branch_key(key, 0), turn)
        choice = sobol_2d(branch_key(key, 1), turn)
        picked = bsdf_sample(point.bsdf, point.normal, point.view, u, choice[0])
        sample.direction = picked.direction
        sample.distance = wp.inf
        if picked.density > 0.0:
            both = picked.density + environment_density(environment, picked.direction)
            sample.irradiance = environment_radiance(environment, picked.direction) / both
    else:
        sample = sample_environment(environment, sobol_2d(key, turn))
        if sample.density > 0.0:
            other = bsdf_pdf(point.bsdf, point.normal, point.view, sample.direction)
            sample.irradiance = sample.irradiance * (sample.density / (sample.density + other))
    return by_way_of(point, sample, point.occlusion)
