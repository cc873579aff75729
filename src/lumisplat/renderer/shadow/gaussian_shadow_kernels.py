"""How much of a light passes Gaussians.

One item is ``lanes`` consecutive rays, in packets of those that start and point alike, as in
``gaussian_trace_kernels``. Transmittances multiply, so nothing has to be in order, and the trees are traversed once.

``shadow_by_all`` visits the farthest children first: Gaussians at the far end of the rays end them sooner than those
around the points do, many of which hardly absorb. ``shadow_by_first_hits`` visits the nearest ones first, and keeps the
nearest hits in lists.

The equations are in docs/method/shadows.md.
"""

import functools
from typing import Any

import warp as wp

from lumisplat.constants import TRAVERSE_STACK
from lumisplat.device.bvh.node_stack import FAR_FIRST, NEAR_FIRST, node_stack_of, push_root
from lumisplat.device.bvh.node_test import lesser
from lumisplat.device.bvh.ray_packet import PACKET_OPTIONS, packet_of
from lumisplat.device.gaussian.particle import load_particle
from lumisplat.device.light.packet_shadow import (
    begin_absorption,
    begin_first_hits,
    end_rays,
    farthest_reach,
    packet_absorption_of,
    packet_first_hits_of,
    shadow_of_list,
)
from lumisplat.device.light.shadow import passed_share, shadow_key, shadow_of
from lumisplat.device.structs.bvh import FAR, HIT_PEAK, WORLD, ChildLinks, Particle, SceneBvh, ShadowData
from lumisplat.device.structs.packet import PacketPlace
from lumisplat.device.structs.rays import RayData

wp.set_module_options(PACKET_OPTIONS)


@functools.cache
def shadow_kernel(lanes: int, entries: int = TRAVERSE_STACK) -> Any:
    """The kernel of shadows by all Gaussians, for items of ``lanes`` rays; up to ``entries`` nodes wait."""
    LANES = lanes
    stacks = node_stack_of(entries)
    NodeStackStorage, node_stack = stacks.storage, stacks.node_stack
    tools, shadows = packet_of(lanes), packet_absorption_of(lanes)
    RaysStorage, packet_rays, begin_packet = tools.rays_storage, tools.packet_rays, tools.begin_packet
    ends_of, largest = tools.ends_of, tools.largest
    enter_instance, visit_node = tools.enter_instance, tools.visit_node
    AbsorptionStorage, absorption_of, absorb = shadows.storage, shadows.absorption_of, shadows.absorb

    @wp.kernel(module="unique", module_options=PACKET_OPTIONS)
    def shadow_by_all(
        start: int,
        settings: wp.array[ShadowData],
        scene: SceneBvh,
        rays: RayData,
        limits: wp.array[float],
        skips: wp.array[wp.bool],
        light_inout: wp.array[wp.vec3],
    ):
        """Multiplies the light of each ray with what the Gaussians up to its limit let through."""
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
        place = PacketPlace()
        while largest(waiting) > 0.0:
            begin_packet(packet, waiting, rays, first, scene.packet_radius)
            begin_absorption(absorption, packet, config, rays, first)
            top = push_root(stack)
            enter_instance(place, packet, WORLD, scene, rays, first)
            reach = end_rays(packet, place, skips, first)
            while top > 0:
                top -= 1
                number = stack[top].instance
                if number != place.number:
                    enter_instance(place, packet, number, scene, rays, first)
                    reach = end_rays(packet, place, skips, first)
                leaf_count = visit_node(stack, top, leaves, place, scene, 0.0, reach, FAR_FIRST, HIT_PEAK, FAR)
                found = int(0)
                for leaf in range(leaf_count):
                    load_particle(scene.assets[place.instance.asset].particles, leaves[leaf], particle)
                    found = found | absorb(
                        absorption, packet, particle, place.instance, config, scene, rays, first, key
                    )
                if found != 0 and largest(absorption.transmittance) <= 0.0:
                    top = int(0)
            for lane in range(LANES):
                if absorption.floor[lane] < FAR:
                    tint = wp.vec3(absorption.tint[0, lane], absorption.tint[1, lane], absorption.tint[2, lane])
                    passed = passed_share(config, absorption.transmittance[lane])
                    shadow = shadow_of(config, passed, tint)
                    light_inout[first + lane] = wp.cw_mul(light_inout[first + lane], shadow)

    return shadow_by_all


@functools.cache
def first_hits_shadow_kernel(lanes: int, entries: int = TRAVERSE_STACK) -> Any:
    """The kernel of shadows by the nearest Gaussians, for items of ``lanes`` rays; up to ``entries`` nodes wait."""
    LANES = lanes
    stacks = node_stack_of(entries)
    NodeStackStorage, node_stack = stacks.storage, stacks.node_stack
    tools, shadows = packet_of(lanes), packet_first_hits_of(lanes)
    RaysStorage, packet_rays, begin_packet = tools.rays_storage, tools.packet_rays, tools.begin_packet
    ends_of, largest = tools.ends_of, tools.largest
    enter_instance, visit_node = tools.enter_instance, tools.visit_node
    FirstHitsStorage, first_hits_of, keep_first_hits = shadows.storage, shadows.first_hits_of, shadows.keep_first_hits

    @wp.kernel(module="unique", module_options=PACKET_OPTIONS)
    def shadow_by_first_hits(
        start: int,
        settings: wp.array[ShadowData],
        scene: SceneBvh,
        rays: RayData,
        limits: wp.array[float],
        skips: wp.array[wp.bool],
        light_inout: wp.array[wp.vec3],
    ):
        """Multiplies the light of each ray with what the nearest Gaussians up to its limit let through."""
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
        place = PacketPlace()
        while largest(waiting) > 0.0:
            begin_packet(packet, waiting, rays, first, scene.packet_radius)
            begin_first_hits(first_hits)
            reach = farthest_reach(first_hits, packet)
            top = push_root(stack)
            enter_instance(place, packet, WORLD, scene, rays, first)
            counted = end_rays(packet, place, skips, first)
            while top > 0:
                top -= 1
                if stack[top].entry <= reach:
                    number = stack[top].instance
                    if number != place.number:
                        enter_instance(place, packet, number, scene, rays, first)
                        counted = end_rays(packet, place, skips, first)
                    near = lesser(reach, counted)
                    leaf_count = visit_node(stack, top, leaves, place, scene, 0.0, near, NEAR_FIRST, HIT_PEAK, FAR)
                    found = int(0)
                    for leaf in range(leaf_count):
                        load_particle(scene.assets[place.instance.asset].particles, leaves[leaf], particle)
                        found = found | keep_first_hits(
                            first_hits, packet, particle, place.instance, config, scene, rays, first
                        )
                    if found != 0:
                        reach = farthest_reach(first_hits, packet)
            for lane in range(LANES):
                if packet.limit[lane] > 0.0:
                    shadow = shadow_of_list(config, scene, first_hits.hits, first_hits.lists[lane])
                    light_inout[first + lane] = wp.cw_mul(light_inout[first + lane], shadow)

    return shadow_by_first_hits
