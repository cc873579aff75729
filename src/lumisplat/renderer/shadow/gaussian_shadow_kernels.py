"""What of a light comes through Gaussians.

One item is ``lanes`` consecutive rays, in packets of those that start and point alike, as in
``gaussian_trace_kernels``. Transmittances multiply, so nothing has to be in order, and the trees are traversed once.

``shadow_by_all`` goes far from the points first: what the light shines on first blocks it from all that is behind,
while around the points themselves there is much that hardly does. ``shadow_by_first_hits`` goes near first, and keeps
the nearest hits in lists.

The equations are in docs/method/shadows.md.
"""

import functools
from typing import Any

import warp as wp

from lumisplat.constants import HITS_PER_PASS_MAX
from lumisplat.device.bvh.hit_list import empty_list, is_before, keep_hit
from lumisplat.device.bvh.node_stack import FAR_FIRST, NEAR_FIRST, begin_traversal
from lumisplat.device.bvh.node_test import larger, lesser
from lumisplat.device.bvh.ray_packet import PACKET_OPTIONS, StackRoom, packet_of, room_for, stack_in
from lumisplat.device.gaussian.compositing import instance_of
from lumisplat.device.gaussian.packet_hits import packet_hits_of
from lumisplat.device.light.shadow import shadow_key, shadow_of, tint_of
from lumisplat.device.math.random import draw_stratified
from lumisplat.device.structs.bvh import FAR, ChildLinks, Particle, SceneBvh, ShadowData
from lumisplat.device.structs.declare import struct
from lumisplat.device.structs.packet import Hit, HitList, PacketPlace, PacketRays, WaitingNode
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options(PACKET_OPTIONS)


@struct
class Absorption:
    """What a packet has gone through, one lane a ray; arrays on the stack of a thread."""

    transmittance: wp.array(dtype=float)
    """0 for rays that are not of the packet."""
    tint: wp.array(dtype=float, ndim=2)
    """Sum of linear colours, weighted by alpha: red, green and blue, and the lane."""


@struct
class FirstHits:
    """The nearest hits of a packet, one lane a ray; arrays on the stack of a thread."""

    lists: wp.array(dtype=HitList)
    hits: wp.array(dtype=Hit)
    """The slots of the lists of all rays."""
    cut_t: wp.array(dtype=float)
    """Hits from (cut_t, cut_index) on do not count."""
    cut_index: wp.array(dtype=int)


@wp.func
def begin_absorption(absorption: Absorption, packet: PacketRays):
    """Nothing absorbed yet."""
    for lane in range(absorption.transmittance.shape[0]):
        absorption.transmittance[lane] = wp.where(packet.limit[lane] > 0.0, 1.0, 0.0)
        for k in range(3):
            absorption.tint[k, lane] = 0.0


@wp.func
def begin_first_hits(first_hits: FirstHits):
    """No hits yet."""
    lanes = first_hits.lists.shape[0]
    for lane in range(lanes):
        first_hits.lists[lane] = empty_list(lane * (first_hits.hits.shape[0] // lanes))
        first_hits.cut_t[lane] = FAR
        first_hits.cut_index[lane] = -1


@wp.func
def end_rays(packet: PacketRays, instance: SplatInstanceData, skips: wp.array(dtype=wp.bool), first: int):
    """Ends rays at their limits; those that skip shadow-only instances do not see such a one."""
    for lane in range(packet.t_max.shape[0]):
        is_skipped = instance.shadow_only != 0 and skips[first + lane]
        packet.t_max[lane] = wp.where(is_skipped, -FAR, packet.limit[lane])


@wp.func
def nearest_begin(packet: PacketRays) -> float:
    """The least distance at which a hit may count."""
    begin = float(FAR)
    for lane in range(packet.t_min.shape[0]):
        if packet.limit[lane] > 0.0:
            begin = lesser(begin, packet.t_min[lane])
    return begin


@wp.func
def farthest_reach(first_hits: FirstHits, packet: PacketRays) -> float:
    """The largest distance at which a hit may count."""
    reach = float(-FAR)
    for lane in range(first_hits.cut_t.shape[0]):
        reach = larger(reach, lesser(first_hits.cut_t[lane], packet.limit[lane]))
    return reach


@wp.func
def shadow_of_list(view: ShadowData, scene: SceneBvh, hits: wp.array(dtype=Hit), kept: HitList) -> wp.vec3:
    """Factor of the light that comes through the hits of a list."""
    transmittance = float(1.0)
    tint = wp.vec3()
    for j in range(kept.head, kept.tail):
        alpha = hits[j].alpha
        transmittance = transmittance * (1.0 - alpha)
        if view.color_strength > 0.0:
            index = hits[j].index
            instance = scene.instances[instance_of(scene.instances, index)]
            tint += alpha * tint_of(scene.assets[instance.asset].gaussians, index - instance.first)
    return shadow_of(view, transmittance, tint)


@functools.cache
def shadow_kernel(lanes: int) -> Any:
    """The kernel of shadows by all Gaussians, for items of ``lanes`` rays."""
    LANES = lanes
    tools, hit_tools = packet_of(lanes), packet_hits_of(lanes)
    Floats, Vec3s = tools.floats, tools.vec3s
    RaysRoom, rays_in, begin_packet = tools.rays_room, tools.rays_in, tools.begin_packet
    ends_of, largest = tools.ends_of, tools.largest
    enter_instance, visit_node = tools.enter_instance, tools.visit_node
    hit_responses, alphas_at = hit_tools.hit_responses, hit_tools.alphas_at

    @struct
    class AbsorptionRoom:
        """The variable in which an Absorption lies."""

        transmittance: Floats
        tint: Vec3s

    @wp.func
    def absorption_in(room: wp.ref[AbsorptionRoom]) -> Absorption:
        """What lies in a variable."""
        absorption = Absorption()
        absorption.transmittance = wp.array(ptr=wp.address_of(room.transmittance), shape=(LANES,), dtype=float)
        absorption.tint = wp.array(ptr=wp.address_of(room.tint), shape=(3, LANES), dtype=float)
        return absorption

    @wp.func
    def absorb(
        absorption: Absorption,
        packet: PacketRays,
        particle: Particle,
        instance: SplatInstanceData,
        view: ShadowData,
        scene: SceneBvh,
        key: wp.uint32,
    ) -> int:
        """Adds what a Gaussian absorbs; returns 1 if a ray hits it, else 0."""
        is_hit, across2, along2 = hit_responses(particle, packet)
        found = int(0)
        for lane in range(LANES):
            found = found | is_hit[lane]
        if found == 0:
            return 0
        distance2 = Floats()
        for lane in range(LANES):
            distance2[lane] = across2[lane] / along2[lane]
        alpha = alphas_at(instance.kernel, particle, distance2)
        if view.stochastic != 0:
            number = draw_stratified(key, view.sample, instance.first + particle.index)
            for lane in range(LANES):
                alpha[lane] = wp.where(number < alpha[lane], 1.0, 0.0)
        for lane in range(LANES):
            alpha[lane] = wp.where(is_hit[lane] != 0, alpha[lane], 0.0)
            absorption.transmittance[lane] = absorption.transmittance[lane] * (1.0 - alpha[lane])
        if view.color_strength > 0.0 and view.stochastic == 0:
            color = tint_of(scene.assets[instance.asset].gaussians, particle.index)
            for lane in range(LANES):
                for k in range(3):
                    absorption.tint[k, lane] = absorption.tint[k, lane] + alpha[lane] * color[k]
        return 1

    @wp.kernel(module="unique", module_options=PACKET_OPTIONS)
    def shadow_by_all(
        start: int,
        settings: wp.array(dtype=ShadowData),
        scene: SceneBvh,
        rays: RayData,
        limits: wp.array(dtype=float),
        skips: wp.array(dtype=wp.bool),
        light_inout: wp.array(dtype=wp.vec3),
    ):
        """Multiplies the light of each ray with what the Gaussians up to its limit let through."""
        first = (start + wp.tid()) * LANES
        view = settings[0]
        black = wp.max(view.transmittance_min, view.threshold)
        key = shadow_key(view)
        waiting = ends_of(rays, limits, first)
        if largest(waiting) < 0.0:
            return

        absorption_room = AbsorptionRoom()
        absorption = absorption_in(absorption_room)
        packet_room = RaysRoom()
        packet = rays_in(packet_room)
        stack_room = StackRoom()
        stack = stack_in(stack_room)
        leaves = ChildLinks()
        place = PacketPlace()
        while largest(waiting) > 0.0:
            begin_packet(packet, waiting, rays, first, scene.packet_radius)
            begin_absorption(absorption, packet)
            begin = nearest_begin(packet)
            reach = largest(packet.limit)
            top = begin_traversal(stack, place)
            while top > 0:
                top -= 1
                number = stack[top].instance
                if number != place.number:
                    enter_instance(place, packet, number, scene, rays, first)
                    end_rays(packet, place.instance, skips, first)
                leaf_count = visit_node(stack, top, leaves, place, scene, begin, reach, FAR_FIRST)
                found = int(0)
                for leaf in range(leaf_count):
                    particle = scene.assets[place.instance.asset].particles[leaves[leaf]]
                    found = found | absorb(absorption, packet, particle, place.instance, view, scene, key)
                if found != 0 and largest(absorption.transmittance) <= black:
                    top = int(0)
            for lane in range(LANES):
                if packet.limit[lane] > 0.0:
                    tint = wp.vec3(absorption.tint[0, lane], absorption.tint[1, lane], absorption.tint[2, lane])
                    shadow = shadow_of(view, absorption.transmittance[lane], tint)
                    light_inout[first + lane] = wp.cw_mul(light_inout[first + lane], shadow)

    return shadow_by_all


@functools.cache
def first_hits_shadow_kernel(lanes: int) -> Any:
    """The kernel of shadows by the nearest Gaussians, for items of ``lanes`` rays."""
    LANES = lanes
    HITS = lanes * HITS_PER_PASS_MAX
    tools, hit_tools = packet_of(lanes), packet_hits_of(lanes)
    Floats, Ints = tools.floats, tools.ints
    RaysRoom, rays_in, begin_packet = tools.rays_room, tools.rays_in, tools.begin_packet
    ends_of, largest = tools.ends_of, tools.largest
    enter_instance, visit_node = tools.enter_instance, tools.visit_node
    hit_distances, alphas_at = hit_tools.hit_distances, hit_tools.alphas_at

    @struct
    class FirstHitsRoom:
        """The variable in which FirstHits lie."""

        lists: room_for(HitList, lanes)
        hits: room_for(Hit, HITS)
        cut_t: Floats
        cut_index: Ints

    @wp.func
    def first_hits_in(room: wp.ref[FirstHitsRoom]) -> FirstHits:
        """The hits that lie in a variable."""
        first_hits = FirstHits()
        first_hits.lists = wp.array(ptr=wp.address_of(room.lists), shape=(LANES,), dtype=HitList)
        first_hits.hits = wp.array(ptr=wp.address_of(room.hits), shape=(HITS,), dtype=Hit)
        first_hits.cut_t = wp.array(ptr=wp.address_of(room.cut_t), shape=(LANES,), dtype=float)
        first_hits.cut_index = wp.array(ptr=wp.address_of(room.cut_index), shape=(LANES,), dtype=int)
        return first_hits

    @wp.func
    def keep_hits(
        first_hits: FirstHits, packet: PacketRays, particle: Particle, instance: SplatInstanceData, view: ShadowData
    ) -> int:
        """Adds the hits of a Gaussian to the lists of their rays; returns 1 if a ray hits it, else 0."""
        t, distance2 = hit_distances(particle, view.hull, packet)
        found = int(0)
        for lane in range(LANES):
            found = found | wp.where(t[lane] < FAR, 1, 0)
        if found == 0:
            return 0
        alpha = alphas_at(instance.kernel, particle, distance2)
        hit = Hit()
        hit.index = instance.first + particle.index
        for lane in range(LANES):
            cut_t = first_hits.cut_t[lane]
            cut_index = first_hits.cut_index[lane]
            if is_before(t[lane], hit.index, cut_t, cut_index):
                hit.t = t[lane]
                hit.alpha = alpha[lane]
                keep_hit(first_hits.hits, first_hits.lists[lane], view.hits, hit, cut_t, cut_index)
                # The farthest hit of a full list is the cut: it is in the list, and none behind it will be.
                kept = first_hits.lists[lane]
                if kept.tail == kept.begin + view.hits:
                    first_hits.cut_t[lane] = first_hits.hits[kept.tail - 1].t
                    first_hits.cut_index[lane] = first_hits.hits[kept.tail - 1].index
        return 1

    @wp.kernel(module="unique", module_options=PACKET_OPTIONS)
    def shadow_by_first_hits(
        start: int,
        settings: wp.array(dtype=ShadowData),
        scene: SceneBvh,
        rays: RayData,
        limits: wp.array(dtype=float),
        skips: wp.array(dtype=wp.bool),
        light_inout: wp.array(dtype=wp.vec3),
    ):
        """Multiplies the light of each ray with what the nearest Gaussians up to its limit let through."""
        first = (start + wp.tid()) * LANES
        view = settings[0]
        waiting = ends_of(rays, limits, first)
        if largest(waiting) < 0.0:
            return

        first_hits_room = FirstHitsRoom()
        first_hits = first_hits_in(first_hits_room)
        packet_room = RaysRoom()
        packet = rays_in(packet_room)
        stack_room = StackRoom()
        stack = stack_in(stack_room)
        leaves = ChildLinks()
        place = PacketPlace()
        while largest(waiting) > 0.0:
            begin_packet(packet, waiting, rays, first, scene.packet_radius)
            begin_first_hits(first_hits)
            begin = nearest_begin(packet)
            reach = farthest_reach(first_hits, packet)
            top = begin_traversal(stack, place)
            while top > 0:
                top -= 1
                if stack[top].entry <= reach:
                    number = stack[top].instance
                    if number != place.number:
                        enter_instance(place, packet, number, scene, rays, first)
                        end_rays(packet, place.instance, skips, first)
                    leaf_count = visit_node(stack, top, leaves, place, scene, begin, reach, NEAR_FIRST)
                    found = int(0)
                    for leaf in range(leaf_count):
                        particle = scene.assets[place.instance.asset].particles[leaves[leaf]]
                        found = found | keep_hits(first_hits, packet, particle, place.instance, view)
                    if found != 0:
                        reach = farthest_reach(first_hits, packet)
            for lane in range(LANES):
                if packet.limit[lane] > 0.0:
                    shadow = shadow_of_list(view, scene, first_hits.hits, first_hits.lists[lane])
                    light_inout[first + lane] = wp.cw_mul(light_inout[first + lane], shadow)

    return shadow_by_first_hits
