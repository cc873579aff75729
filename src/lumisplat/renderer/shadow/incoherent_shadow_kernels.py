"""How much of a light passes Gaussians, on incoherent rays: one item is one ray, which walks the trees alone.

The result is that of ``shadow_by_all`` in ``gaussian_shadow_kernels`` but for rounding: transmittances multiply in
another order. The equations are in docs/method/shadows.md.
"""

import warp as wp

from lumisplat.device.bvh.ray_nodes import (
    LinkStackStorage,
    enter_tree,
    link_stack,
    load_node,
    push_entered,
    push_link,
)
from lumisplat.device.bvh.ray_packet import PACKET_OPTIONS
from lumisplat.device.gaussian.layers import is_other_layer, thin_axis, world_mean
from lumisplat.device.gaussian.particle import load_particle
from lumisplat.device.gaussian.ray_hit import alpha_at, begin_past, hit_particle, ray_in_instance, world_ray
from lumisplat.device.light.shadow import passed_share, shadow_floor, shadow_key, shadow_of, tint_of
from lumisplat.device.math.random import draw_stratified
from lumisplat.device.structs.bvh import (
    DRAWS_NONE,
    DRAWS_PER_RAY,
    DRAWS_SHARED,
    FAR,
    HIT_PEAK,
    Node,
    Particle,
    SceneBvh,
    ShadowData,
)
from lumisplat.device.structs.light import RayAbsorption
from lumisplat.device.structs.packet import WaitingLink
from lumisplat.device.structs.rays import RayData

wp.set_module_options(PACKET_OPTIONS)


@wp.func
def absorbed_share(alpha: float, index: int, config: ShadowData, key: wp.uint32) -> float:
    """What a Gaussian takes of a ray, of which its alpha is this, by what is drawn at random."""
    if config.draws == DRAWS_SHARED:
        return wp.where(config.acceptance_scale * draw_stratified(key, config.sample, index) < alpha, 1.0, 0.0)
    if config.draws == DRAWS_PER_RAY:
        return wp.min(alpha / config.acceptance_scale, 1.0)
    return alpha


@wp.func
def absorb_in_instance(
    stack: wp.array[WaitingLink],
    top: int,
    i: int,
    number: int,
    end: float,
    config: ShadowData,
    scene: SceneBvh,
    rays: RayData,
    light: wp.ref[RayAbsorption],
):
    """Takes ray ``i`` through the Gaussians of instance ``number``, on the stack above ``top``."""
    instance = scene.instances[number]
    ray = ray_in_instance(i, instance, HIT_PEAK, rays)
    key = shadow_key(config)
    t_min = rays.t_min[i]
    node = Node()
    particle = Particle()
    height = int(top)
    push_link(stack, height, 0)
    while height > top:
        height -= 1
        link = stack[height].link
        if link >= 0:
            load_node(scene.assets[instance.asset].nodes, link, node)
            push_entered(stack, height, node, enter_tree(node, ray, HIT_PEAK, end), end)
        else:
            load_particle(scene.assets[instance.asset].particles, ~link, particle)
            begin = begin_past(t_min, config.offset, config.offset_absolute, particle, instance.scale)
            hit = hit_particle(particle, ray, instance.scale, HIT_PEAK, begin, end)
            counts = hit.t < FAR
            if counts and hit.is_near:
                gaussians = scene.assets[instance.asset].gaussians
                mean, axis = world_mean(particle, instance), thin_axis(particle, instance)
                counts = is_other_layer(i, begin, mean, axis, particle, instance, gaussians, rays)
            if counts:
                alpha = alpha_at(instance.kernel, particle, hit.distance2)
                alpha = absorbed_share(alpha, instance.first + particle.index, config, key)
                light.transmittance *= 1.0 - alpha
                if config.color_strength > 0.0 and config.draws == DRAWS_NONE:
                    light.tint += alpha * tint_of(scene.assets[instance.asset].gaussians, particle.index)
                if light.transmittance <= light.floor:
                    light.transmittance = 0.0
                    height = int(top)


@wp.kernel
def shadow_ray_by_ray(
    start: int,
    order: wp.array[int],
    settings: wp.array[ShadowData],
    scene: SceneBvh,
    rays: RayData,
    limits: wp.array[float],
    skips: wp.array[wp.bool],
    light_inout: wp.array[wp.vec3],
):
    """Multiplies the light of a ray with what the Gaussians up to its limit let through, in this order of the rays."""
    i = order[start + wp.tid()]
    if not rays.is_active[i] or not limits[i] > 0.0:
        return
    config = settings[0]
    end = wp.min(limits[i], FAR)
    light = RayAbsorption()
    light.transmittance = 1.0
    light.floor = shadow_floor(config, rays.pixel_key[i], rays.sample[i])
    storage = LinkStackStorage()
    stack = link_stack(storage)
    node = Node()
    world = world_ray(i, 0.0, rays)
    top = int(0)
    push_link(stack, top, 0)
    while top > 0 and light.transmittance > 0.0:
        top -= 1
        link = stack[top].link
        if link >= 0:
            load_node(scene.tlas_nodes, link, node)
            push_entered(stack, top, node, enter_tree(node, world, HIT_PEAK, end), end)
        elif scene.instances[~link].shadow_only == 0 or not skips[i]:
            absorb_in_instance(stack, top, i, ~link, end, config, scene, rays, light)
    shadow = shadow_of(config, passed_share(config, light.transmittance), light.tint)
    light_inout[i] = wp.cw_mul(light_inout[i], shadow)
