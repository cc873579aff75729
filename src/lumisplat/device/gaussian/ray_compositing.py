"""Blending of what a ray meets, and the lottery of a stochastic pass (docs/method/ray_tracing.md#strategies)."""

import warp as wp

from lumisplat.device.gaussian.compositing import instance_of, lay_behind
from lumisplat.device.gaussian.particle import ellipsoid_normal, gaussian_color, gaussian_facing
from lumisplat.device.gaussian.projection import towards
from lumisplat.device.math.random import draw
from lumisplat.device.structs.bvh import AssetBvh, BvhInstance, TraceData
from lumisplat.device.structs.rays import GaussianHits, Ray
from lumisplat.device.structs.scene import BlendState

wp.set_module_options({"enable_backward": False})


@wp.func
def empty_pixel() -> BlendState:
    """Nothing blended yet."""
    pixel = BlendState()
    pixel.transmittance = 1.0
    pixel.splat = -1
    return pixel


@wp.func
def load_pixel(radiance: GaussianHits, ray: int) -> BlendState:
    """What a ray has blended so far."""
    pixel = BlendState()
    pixel.color = radiance.color[ray]
    pixel.normal = radiance.normal[ray]
    pixel.transmittance = radiance.transmittance[ray]
    pixel.splat = radiance.gaussian[ray]
    pixel.hits = radiance.hits[ray]
    return pixel


@wp.func
def store_pixel(radiance: GaussianHits, ray: int, pixel: BlendState):
    """Keeps what a ray has blended so far."""
    radiance.color[ray] = pixel.color
    radiance.normal[ray] = pixel.normal
    radiance.transmittance[ray] = pixel.transmittance
    radiance.gaussian[ray] = pixel.splat
    radiance.hits[ray] = pixel.hits


@wp.func
def blend_hit(
    pixel: BlendState,
    view: TraceData,
    instances: wp.array(dtype=BvhInstance),
    assets: wp.array(dtype=AssetBvh),
    ray: Ray,
    index: int,
    alpha: float,
) -> BlendState:
    """Adds the Gaussian ``index`` of the scene behind those already there.

    Its colour and plane are those that the unfolded eye sees: a plane mirror shows what a mirrored camera would.
    """
    number = instance_of(instances, index)
    instance = instances[number]
    i = index - instance.first
    gaussians = assets[instance.asset].gaussians
    origin = instance.object_from_world * ray.origin + instance.object_from_world_offset
    direction = instance.object_from_world * ray.direction
    eye = origin - ray.path_length * direction
    color = wp.vec3()
    if instance.own_colors != 0:
        color = gaussians.albedo[i]
    else:
        color = gaussian_color(gaussians, i, eye, instance.sh_degree)
    normal = wp.vec3()
    if instance.own_normals != 0:
        normal = towards(gaussians.normals[i], -direction)
    elif view.ellipsoid_normal != 0:
        normal = ellipsoid_normal(instance.kernel, gaussians, i, origin, direction)
    else:
        normal = gaussian_facing(gaussians, i, eye)
    normal = instance.world_from_object * normal
    return lay_behind(pixel, color, normal, index, alpha, view.depth_iso_transmittance)


@wp.func
def end_pass(pixel: BlendState, sample_key: wp.uint32, last: int) -> BlendState:
    """Decides about a stochastic pass whose farthest Gaussian is ``last``, by what its own Gaussians hide.

    Chosen, it is shown for all passes: its transmittance is 0, its surface ``last`` unless it has one. Otherwise the
    next one starts from nothing. The expectation is that of blending all: a pass is reached with the probability that
    what lies before lets through, chosen with that of what it hides, and shown divided by that.
    """
    opacity = 1.0 - pixel.transmittance
    if draw(sample_key, wp.uint32(last)) >= opacity:
        return empty_pixel()
    pixel.color = pixel.color / opacity
    pixel.normal = pixel.normal / opacity
    pixel.transmittance = 0.0
    if pixel.splat < 0:
        pixel.splat = last
    return pixel
