"""Kernels of shadow rays through Gaussians: their transmittance (docs/method/shadows.md).

Transmittances may be multiplied in any order, so BVHs are traversed only once. ``shadow_by_all`` and
``shadow_by_first_hits`` trace packets of consecutive rays with similar origins and directions. ``shadow_by_all`` visits
the farthest children first, because Gaussians far from the rays' origins absorb more than those around the origins, so
that rays end sooner. ``shadow_by_first_hits`` visits the nearest children first and lists the nearest hits.
``shadow_ray_by_ray`` traces incoherent rays one by one; its result equals that of ``shadow_by_all`` up to rounding.
"""

import functools
from typing import Any

import warp as wp

from lumisplat.constants import TRAVERSE_STACK
from lumisplat.device.bvh.nodes import (
    LinkStackStorage,
    enter_tree,
    lesser,
    link_stack,
    load_node,
    push_entered,
    push_link,
)
from lumisplat.device.bvh.packet import (
    FAR_FIRST,
    NEAR_FIRST,
    PACKET_BOUNDS,
    PACKET_OPTIONS,
    SPREAD_MAX,
    group_of,
    largest_of,
    node_stack_of,
    packet_of,
    push_root,
)
from lumisplat.device.gaussian.layers import is_other_layer, thin_axis, world_mean
from lumisplat.device.gaussian.particle import (
    alpha_at,
    begin_past,
    hit_particle,
    load_particle,
    ray_in_instance,
    world_ray,
)
from lumisplat.device.light.shadow_rays import (
    TINTED_TRANSMITTANCE_MIN,
    add_tint,
    begin_absorption,
    begin_first_hits,
    end_rays,
    farthest_reach,
    is_tinted,
    packet_absorption_of,
    packet_first_hits_of,
    shadow_floor,
    shadow_key,
    shadow_of,
    shadow_of_list,
    tint_of,
)
from lumisplat.device.math.random import draw_stratified
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import (
    DRAWS_PER_RAY,
    DRAWS_SHARED,
    FAR,
    HIT_PEAK,
    WORLD,
    ChildLinks,
    Node,
    PacketTree,
    Particle,
    SceneBvh,
    ShadowData,
    WaitingLink,
)
from lumisplat.device.structs.rays import RayData

wp.set_module_options(PACKET_OPTIONS)


@struct
class RayAbsorption:
    """Light that a shadow ray has lost to the Gaussians hit so far."""

    transmittance: float
    """Product of 1 - alpha over the Gaussians hit so far; 0: the ray is blocked."""
    floor: float
    """Transmittance at or below which the ray counts as blocked, so that its traversal ends."""
    tint: wp.vec4
    """Linear colour times alpha, and alpha, summed over the Gaussians hit so far; the sums tint coloured shadows."""


@functools.cache
def shadow_kernel(lanes: int, entries: int = TRAVERSE_STACK) -> Any:
    """Returns the kernel of shadows by all Gaussians, for packets of ``lanes`` rays and stacks of ``entries`` nodes."""
    LANES = lanes
    options = {**PACKET_OPTIONS, "block_dim": PACKET_BOUNDS[0]}
    stacks = node_stack_of(entries)
    NodeStackStorage, node_stack = stacks.storage, stacks.node_stack
    tools, shadows = packet_of(lanes), packet_absorption_of(lanes)
    RaysStorage, packet_rays, begin_packet = tools.rays_storage, tools.packet_rays, tools.begin_packet
    ends_of, largest = tools.ends_of, tools.largest
    enter_instance, visit_node = tools.enter_instance, tools.visit_node
    AbsorptionStorage, absorption_of, absorb = shadows.storage, shadows.absorption_of, shadows.absorb

    @wp.kernel(module="unique", module_options=options, launch_bounds=PACKET_BOUNDS)
    def shadow_by_all(
        start: int,
        settings: wp.array[ShadowData],
        scene: SceneBvh,
        rays: RayData,
        limits: wp.array[float],
        skips: wp.array[wp.bool],
        light_inout: wp.array[wp.vec3],
    ):
        """Multiplies each ray's light by the transmittance of all Gaussians before ``limits``.

        Rays with ``skips`` pass through shadow catchers.
        """
        first = (start + wp.tid()) * LANES
        config = settings[0]
        key = shadow_key(config)
        waiting = ends_of(rays, limits, first)
        if largest(waiting) < 0.0:
            return

        absorption_storage = AbsorptionStorage()
        absorption = absorption_of(absorption_storage)
        rays_storage = RaysStorage()
        packet = packet_rays(rays_storage)
        stack_storage = NodeStackStorage()
        stack = node_stack(stack_storage)
        leaves = ChildLinks()
        particle = Particle()
        tree = PacketTree()
        while largest(waiting) > 0.0:
            begin_packet(packet, waiting, rays, first, scene.packet_radius)
            packet.group = group_of(rays.origin[first], rays.direction[first], scene.packet_radius, SPREAD_MAX)
            begin_absorption(absorption, packet, config, rays, first)
            transmittance_max = float(1.0)
            top = push_root(stack)
            enter_instance(tree, packet, WORLD, scene, rays, first)
            reach = largest_of(packet.group, end_rays(packet, tree, skips, first))
            while top > 0:
                top -= 1
                number = stack[top].instance
                if number != tree.number:
                    enter_instance(tree, packet, number, scene, rays, first)
                    reach = largest_of(packet.group, end_rays(packet, tree, skips, first))
                leaf_count = visit_node(
                    stack, top, leaves, tree, scene, packet.group, 0.0, reach, FAR_FIRST, HIT_PEAK, FAR
                )
                found = int(0)
                for leaf in range(leaf_count):
                    load_particle(scene.assets[tree.instance.asset].particles, leaves[leaf], particle)
                    found = found | absorb(absorption, packet, particle, tree.instance, config, scene, rays, first, key)
                if found != 0:
                    transmittance_max = largest(absorption.transmittance)
                if largest_of(packet.group, transmittance_max) <= 0.0:
                    top = int(0)
            for lane in range(LANES):
                if absorption.floor[lane] < FAR:
                    tint = wp.vec4()
                    for k in range(4):
                        tint[k] = absorption.tint[k, lane]
                    shadow = shadow_of(config, absorption.transmittance[lane], absorption.floor[lane], tint)
                    light_inout[first + lane] = wp.cw_mul(light_inout[first + lane], shadow)

    return shadow_by_all


@functools.cache
def first_hits_shadow_kernel(lanes: int, entries: int = TRAVERSE_STACK) -> Any:
    """Returns the kernel of shadows by the nearest Gaussians; arguments are as for `shadow_kernel`."""
    LANES = lanes
    options = {**PACKET_OPTIONS, "block_dim": PACKET_BOUNDS[0]}
    stacks = node_stack_of(entries)
    NodeStackStorage, node_stack = stacks.storage, stacks.node_stack
    tools, shadows = packet_of(lanes), packet_first_hits_of(lanes)
    RaysStorage, packet_rays, begin_packet = tools.rays_storage, tools.packet_rays, tools.begin_packet
    ends_of, largest = tools.ends_of, tools.largest
    enter_instance, visit_node = tools.enter_instance, tools.visit_node
    FirstHitsStorage, first_hits_of, buffer_first_hits = (
        shadows.storage,
        shadows.first_hits_of,
        shadows.buffer_first_hits,
    )

    @wp.kernel(module="unique", module_options=options, launch_bounds=PACKET_BOUNDS)
    def shadow_by_first_hits(
        start: int,
        settings: wp.array[ShadowData],
        scene: SceneBvh,
        rays: RayData,
        limits: wp.array[float],
        skips: wp.array[wp.bool],
        light_inout: wp.array[wp.vec3],
    ):
        """Multiplies each ray's light by the transmittance of the nearest Gaussians before ``limits``.

        Rays with ``skips`` pass through shadow catchers.
        """
        first = (start + wp.tid()) * LANES
        config = settings[0]
        waiting = ends_of(rays, limits, first)
        if largest(waiting) < 0.0:
            return

        first_hits_storage = FirstHitsStorage()
        first_hits = first_hits_of(first_hits_storage)
        rays_storage = RaysStorage()
        packet = packet_rays(rays_storage)
        stack_storage = NodeStackStorage()
        stack = node_stack(stack_storage)
        leaves = ChildLinks()
        particle = Particle()
        tree = PacketTree()
        while largest(waiting) > 0.0:
            begin_packet(packet, waiting, rays, first, scene.packet_radius)
            packet.group = group_of(rays.origin[first], rays.direction[first], scene.packet_radius, SPREAD_MAX)
            begin_first_hits(first_hits)
            own_reach = farthest_reach(first_hits, packet)
            reach = largest_of(packet.group, own_reach)
            top = push_root(stack)
            enter_instance(tree, packet, WORLD, scene, rays, first)
            counted = largest_of(packet.group, end_rays(packet, tree, skips, first))
            while top > 0:
                top -= 1
                if stack[top].entry <= reach:
                    number = stack[top].instance
                    if number != tree.number:
                        enter_instance(tree, packet, number, scene, rays, first)
                        counted = largest_of(packet.group, end_rays(packet, tree, skips, first))
                    near = lesser(reach, counted)
                    leaf_count = visit_node(
                        stack, top, leaves, tree, scene, packet.group, 0.0, near, NEAR_FIRST, HIT_PEAK, FAR
                    )
                    found = int(0)
                    for leaf in range(leaf_count):
                        load_particle(scene.assets[tree.instance.asset].particles, leaves[leaf], particle)
                        found = found | buffer_first_hits(
                            first_hits, packet, particle, tree.instance, config, scene, rays, first
                        )
                    if found != 0:
                        own_reach = farthest_reach(first_hits, packet)
                    reach = largest_of(packet.group, own_reach)
            for lane in range(LANES):
                if packet.limit[lane] > 0.0:
                    shadow = shadow_of_list(config, scene, first_hits.hits, first_hits.lists[lane])
                    light_inout[first + lane] = wp.cw_mul(light_inout[first + lane], shadow)

    return shadow_by_first_hits


@wp.func
def absorbed_share(alpha: float, index: int, config: ShadowData, key: wp.uint32) -> float:
    """Returns the fraction of a ray's light that a Gaussian of this ``alpha`` absorbs; stochastic shadows: 0 or 1."""
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
    """Updates ``light`` by instance ``number``'s Gaussians on ray ``i``; the traversal uses ``stack`` above ``top``."""
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
                if is_tinted(config):
                    color = tint_of(scene.assets[instance.asset].gaussians, particle.index)
                    light.tint = add_tint(light.tint, alpha, color)
                    light.transmittance = wp.max(light.transmittance, TINTED_TRANSMITTANCE_MIN)
                elif light.transmittance <= light.floor:
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
    """Per ray in ``order``: multiplies the light by the transmittance of the Gaussians up to the ray's limit."""
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
        elif scene.instances[~link].shadow_catcher == 0 or not skips[i]:
            absorb_in_instance(stack, top, i, ~link, end, config, scene, rays, light)
    shadow = shadow_of(config, light.transmittance, light.floor, light.tint)
    light_inout[i] = wp.cw_mul(light_inout[i], shadow)
