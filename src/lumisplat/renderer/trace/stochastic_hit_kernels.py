"""Kernel of stochastic hits of incoherent rays. One thread per ray, which traverses the BVHs alone.

A ray's hit equals that of ``gaussian_trace_kernels`` with ``STRATEGY_HIT``: the nearest of the Gaussians that are
accepted with probability alpha. The equations are in docs/method/ray_tracing.md.
"""

import warp as wp

from lumisplat.device.bvh.nodes import (
    LinkStackStorage,
    enter_tree,
    lesser,
    link_stack,
    load_node,
    push_entered,
    push_link,
)
from lumisplat.device.bvh.packet import PACKET_OPTIONS
from lumisplat.device.gaussian.layers import is_other_layer, thin_axis, world_mean
from lumisplat.device.gaussian.packet_tracing import ray_of, surface_distance
from lumisplat.device.gaussian.particle import (
    alpha_at,
    begin_past,
    hit_particle,
    load_particle,
    ray_in_instance,
    world_ray,
)
from lumisplat.device.gaussian.ray_compositing import blend_hit, store_pixel
from lumisplat.device.math.random import draw
from lumisplat.device.splat.blending import add_relit, begin_relit, empty_pixel
from lumisplat.device.structs.bvh import FAR, HIT_HULL, HIT_MEAN, Hit, Node, Particle, SceneBvh, TraceData, WaitingLink
from lumisplat.device.structs.rays import GaussianHits, RayData

wp.set_module_options(PACKET_OPTIONS)


@wp.func
def find_hit_in_instance(
    stack: wp.array[WaitingLink],
    top: int,
    i: int,
    number: int,
    end: float,
    config: TraceData,
    scene: SceneBvh,
    rays: RayData,
    nearest: wp.ref[Hit],
):
    """Replaces ``nearest``, the nearest hit of ray ``i``, if the ray hits a nearer Gaussian of instance ``number``.

    The traversal uses ``stack`` above entry ``top``.
    """
    instance = scene.instances[number]
    ray = ray_in_instance(i, instance, instance.hit_distance, rays)
    t_min = rays.t_min[i]
    key = rays.sample_key[i]
    node = Node()
    particle = Particle()
    height = int(top)
    push_link(stack, height, 0)
    while height > top:
        height -= 1
        if stack[height].entry <= nearest.t:
            link = stack[height].link
            if link >= 0:
                load_node(scene.assets[instance.asset].nodes, link, node)
                reach = lesser(nearest.t, wp.where(instance.hit_distance == HIT_MEAN, FAR, end))
                push_entered(stack, height, node, enter_tree(node, ray, instance.hit_distance, end), reach)
            else:
                load_particle(scene.assets[instance.asset].particles, ~link, particle)
                begin = begin_past(t_min, config.offset, config.offset_absolute, particle, instance.scale)
                hit = hit_particle(particle, ray, instance.scale, instance.hit_distance, begin, end)
                index = instance.first + particle.index
                counts = hit.t < nearest.t or (hit.t == nearest.t and index < nearest.index)
                if counts and hit.is_near:
                    gaussians = scene.assets[instance.asset].gaussians
                    mean, axis = world_mean(particle, instance), thin_axis(particle, instance)
                    counts = is_other_layer(i, begin, mean, axis, particle, instance, gaussians, rays)
                if counts:
                    alpha = alpha_at(instance.kernel, particle, hit.distance2)
                    if draw(key, wp.uint32(index)) * config.acceptance_scale < alpha:
                        nearest.t = hit.t
                        nearest.index = index


@wp.kernel
def find_stochastic_hits(
    start: int,
    order: wp.array[int],
    settings: wp.array[TraceData],
    scene: SceneBvh,
    rays: RayData,
    limits: wp.array[float],
    hits_out: GaussianHits,
):
    """Finds the Gaussian that each ray hits before its limit; rays are processed in the order of ``order``."""
    i = order[start + wp.tid()]
    config = settings[0]
    pixel = empty_pixel()
    store_pixel(hits_out, i, pixel)
    hits_out.depth[i] = wp.inf
    begin_relit(hits_out, i)
    if not rays.is_active[i] or not limits[i] > 0.0:
        return
    end = wp.min(limits[i], FAR)
    nearest = Hit()
    nearest.t = FAR
    nearest.index = -1
    storage = LinkStackStorage()
    stack = link_stack(storage)
    node = Node()
    world = world_ray(i, scene.footprint, rays)
    top = int(0)
    push_link(stack, top, 0)
    while top > 0:
        top -= 1
        link = stack[top].link
        if link >= 0:
            load_node(scene.tlas_nodes, link, node)
            push_entered(stack, top, node, enter_tree(node, world, HIT_HULL, end), end)
        elif stack[top].entry <= nearest.t or scene.instances[~link].hit_distance == HIT_MEAN:
            find_hit_in_instance(stack, top, i, ~link, end, config, scene, rays, nearest)
    if nearest.index >= 0:
        ray = ray_of(rays, i)
        if config.offset < FAR:
            ray.t_min = 0.0  # small Gaussians count even before the ray's t_min
        blended = blend_hit(pixel, config, scene, ray, nearest.index, 1.0)
        store_pixel(hits_out, i, blended)
        hits_out.depth[i] = surface_distance(scene, ray, end, nearest.index, nearest.t)
        if hits_out.relit_weight:
            add_relit(hits_out, i, scene.instances, pixel, blended, nearest.index)
