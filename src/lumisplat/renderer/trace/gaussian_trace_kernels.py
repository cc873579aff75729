"""Gaussians along rays: packets of neighbouring rays go through the trees together.

One item is ``lanes`` consecutive rays: 16 on the CPU, where a loop over the lanes becomes vector instructions, 1 on
CUDA. Those that start and point alike are a packet. It visits the nearest child first and keeps, for each of its rays,
the nearest hits sorted by (t, index). Hits before all nodes that still wait are final, and are blended at once. A ray
whose list overflows drops its farthest hit, and starts again behind the last one blended: that is a pass. So the result
is that of sorting all hits.

The strategies differ in two places: a stochastic hit is drawn before it enters the list, which then holds one; and a
stochastic pass is drawn whenever k hits were blended.

The equations are in docs/method/ray_tracing.md.
"""

import functools
from typing import Any

import warp as wp

from lumisplat.constants import HITS_KEPT_CPU, HITS_PER_PASS_MAX, PASS_REWIND
from lumisplat.device.bvh.hit_list import empty_list, is_before, keep_hit
from lumisplat.device.bvh.node_stack import NEAR_FIRST, begin_traversal
from lumisplat.device.bvh.node_test import larger, lesser
from lumisplat.device.bvh.ray_packet import PACKET_OPTIONS, StackRoom, packet_of, room_for, stack_in
from lumisplat.device.gaussian.compositing import empty_pixel
from lumisplat.device.gaussian.packet_hits import packet_hits_of
from lumisplat.device.gaussian.ray_compositing import blend_hit, close_pass, load_pixel, store_pixel
from lumisplat.device.math.random import draw_mixed, mix
from lumisplat.device.structs.bvh import FAR, ChildLinks, Particle, SceneBvh, TraceData
from lumisplat.device.structs.declare import struct
from lumisplat.device.structs.packet import Hit, HitList, PacketPlace, PacketRays, WaitingNode
from lumisplat.device.structs.rays import GaussianHits, Ray, RayData
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options(PACKET_OPTIONS)

SORTED = 0
HIT = 1
PASS = 2

STRATEGY_HIT = wp.constant(HIT)
STRATEGY_PASS = wp.constant(PASS)
REWIND = wp.constant(wp.float32(PASS_REWIND))


@struct
class RayProgress:
    """How far a ray has been blended."""

    kept: HitList
    """Hits that are not final yet."""
    next_t: float
    """Distance of the first of them; FAR: there is none."""
    start_t: float
    """Hits up to (start_t, start_index) were blended in earlier passes."""
    start_index: int
    last_t: float
    """The farthest hit that was blended."""
    last_index: int
    blended: int
    """Hits blended in the current stochastic pass."""


@struct
class TracedPacket:
    """A packet while it is traced, one lane a ray; arrays on the stack of a thread."""

    rays: wp.array(dtype=RayProgress)
    hits: wp.array(dtype=Hit)
    """The slots of the lists of all rays."""
    cut_t: wp.array(dtype=float)
    """Hits from (cut_t, cut_index) on are left to another pass."""
    cut_index: wp.array(dtype=int)


@wp.func
def begin_ray_pass(progress: wp.ref[RayProgress], first_slot: int):
    """Empties the list; hits count from behind the last one that was blended."""
    progress.kept = empty_list(first_slot)
    progress.next_t = FAR
    progress.start_t = progress.last_t
    progress.start_index = progress.last_index


@wp.func
def blend_hits(
    progress: wp.ref[RayProgress],
    hits: wp.array(dtype=Hit),
    bound: float,
    view: TraceData,
    scene: SceneBvh,
    rays: RayData,
    i: int,
    radiance: GaussianHits,
) -> bool:
    """Blends the hits of ray ``i`` that are nearer than ``bound``; returns whether it is opaque then."""
    ray = Ray()
    ray.origin = rays.origin[i]
    ray.direction = rays.direction[i]
    ray.path_length = rays.path_length[i]
    pixel = load_pixel(radiance, i)
    is_opaque = bool(False)
    head = int(progress.kept.head)
    tail = int(progress.kept.tail)
    while head < tail and hits[head].t < bound:
        t = hits[head].t
        index = hits[head].index
        alpha = wp.where(view.strategy == STRATEGY_HIT, 1.0, hits[head].alpha)
        head += 1
        pixel = blend_hit(pixel, view, scene.instances, scene.assets, ray, index, alpha)
        if pixel.surface == index:
            radiance.depth[i] = larger(t, 0.0)
        # Rounding may deliver a hit after one that is farther.
        if is_before(progress.last_t, progress.last_index, t, index):
            progress.last_t = t
            progress.last_index = index
        if view.strategy == STRATEGY_PASS:
            progress.blended += 1
            if progress.blended == view.hits_per_pass:
                progress.blended = 0
                pixel = close_pass(pixel, radiance, i, rays.sample_key[i], t, index)
        if pixel.transmittance <= view.transmittance_min:
            is_opaque = True
            head = tail
    store_pixel(radiance, i, pixel)
    progress.kept.head = head
    progress.next_t = FAR
    if head < tail:
        progress.next_t = hits[head].t
    else:
        progress.kept = empty_list(progress.kept.begin)
    return is_opaque


@wp.func
def begin_rays(traced: TracedPacket):
    """Nothing blended yet."""
    for lane in range(traced.rays.shape[0]):
        traced.rays[lane].last_t = -FAR
        traced.rays[lane].last_index = -1
        traced.rays[lane].blended = 0


@wp.func
def begin_pass(traced: TracedPacket, packet: PacketRays, view: TraceData) -> float:
    """Begins a pass of all rays; returns the least distance at which a hit may count."""
    begin = float(FAR)
    slots = traced.hits.shape[0] // traced.rays.shape[0]
    for lane in range(traced.rays.shape[0]):
        begin_ray_pass(traced.rays[lane], lane * slots)
        traced.cut_t[lane] = packet.limit[lane]
        traced.cut_index[lane] = -1
        if packet.limit[lane] > 0.0:
            start = traced.rays[lane].start_t
            before = wp.where(view.hull != 0, -FAR, start - REWIND * wp.abs(start))
            begin = lesser(begin, larger(packet.t_min[lane], before))
    return begin


@wp.func
def blend_final_hits(
    traced: TracedPacket,
    packet: PacketRays,
    bound: float,
    view: TraceData,
    scene: SceneBvh,
    rays: RayData,
    first: int,
    radiance: GaussianHits,
) -> float:
    """Blends the hits that are nearer than ``bound``; returns the distance of the nearest of the others."""
    nearest = float(FAR)
    for lane in range(traced.rays.shape[0]):
        if traced.rays[lane].next_t < bound:
            if blend_hits(traced.rays[lane], traced.hits, bound, view, scene, rays, first + lane, radiance):
                packet.limit[lane] = -FAR
                traced.cut_t[lane] = -FAR
        nearest = lesser(nearest, traced.rays[lane].next_t)
    return nearest


@wp.func
def is_cut(traced: TracedPacket, packet: PacketRays) -> bool:
    """Whether a ray has hits that are left to another pass."""
    found = int(0)
    for lane in range(traced.rays.shape[0]):
        found = found | wp.where(traced.cut_t[lane] < packet.limit[lane], 1, 0)
    return found != 0


@wp.func
def close_last_pass(progress: wp.ref[RayProgress], rays: RayData, i: int, radiance: GaussianHits):
    """Draws the last stochastic pass of ray ``i``, which has fewer hits."""
    if progress.blended > 0:
        pixel = load_pixel(radiance, i)
        pixel = close_pass(pixel, radiance, i, rays.sample_key[i], progress.last_t, progress.last_index)
        store_pixel(radiance, i, pixel)


@functools.cache
def gaussian_trace_kernel(lanes: int) -> Any:
    """The kernel for items of ``lanes`` rays."""
    LANES = lanes
    # CUDA has no more slots than settings may ask for: the lists of its threads lie in local memory.
    HITS = lanes * (HITS_PER_PASS_MAX if lanes == 1 else HITS_KEPT_CPU)
    tools, hit_tools = packet_of(lanes), packet_hits_of(lanes)
    Floats, Ints = tools.floats, tools.ints
    RaysRoom, rays_in, begin_packet = tools.rays_room, tools.rays_in, tools.begin_packet
    ends_of, largest = tools.ends_of, tools.largest
    enter_instance, visit_node = tools.enter_instance, tools.visit_node
    hit_distances, alphas_at = hit_tools.hit_distances, hit_tools.alphas_at

    @struct
    class TracedRoom:
        """The variable in which a TracedPacket lies."""

        rays: room_for(RayProgress, lanes)
        hits: room_for(Hit, HITS)
        cut_t: Floats
        cut_index: Ints

    @wp.func
    def traced_in(room: wp.ref[TracedRoom]) -> TracedPacket:
        """The packet that lies in a variable."""
        traced = TracedPacket()
        traced.rays = wp.array(ptr=wp.address_of(room.rays), shape=(LANES,), dtype=RayProgress)
        traced.hits = wp.array(ptr=wp.address_of(room.hits), shape=(HITS,), dtype=Hit)
        traced.cut_t = wp.array(ptr=wp.address_of(room.cut_t), shape=(LANES,), dtype=float)
        traced.cut_index = wp.array(ptr=wp.address_of(room.cut_index), shape=(LANES,), dtype=int)
        return traced

    @wp.func
    def hits_before_cut(traced: TracedPacket, t: Floats, index: int):
        """Hits before their ray's cut, FAR for the others; and whether there are any."""
        found = int(0)
        for lane in range(LANES):
            is_kept = wp.where(is_before(t[lane], index, traced.cut_t[lane], traced.cut_index[lane]), 1, 0)
            t[lane] = wp.where(is_kept != 0, t[lane], FAR)
            found = found | is_kept
        return t, found

    @wp.func
    def accepted_hits(t: Floats, index: int, alpha: Floats, view: TraceData, rays: RayData, first: int) -> Floats:
        """Stochastic hits that are drawn with probability alpha, FAR for the others."""
        dimension = mix(wp.uint32(index))
        for lane in range(LANES):
            number = draw_mixed(rays.sample_key[first + lane], dimension)
            t[lane] = wp.where(number * view.acceptance_scale < alpha[lane], t[lane], FAR)
        return t

    @wp.func
    def keep_hits(
        traced: TracedPacket,
        packet: PacketRays,
        particle: Particle,
        instance: SplatInstanceData,
        view: TraceData,
        rays: RayData,
        first: int,
    ) -> float:
        """Adds the hits of a Gaussian to the lists of their rays; returns the distance of the nearest first hit."""
        index = instance.first + particle.index
        t, distance2 = hit_distances(particle, view.hull, packet)
        t, found = hits_before_cut(traced, t, index)
        nearest = float(FAR)
        if found == 0:
            return nearest
        alpha = alphas_at(instance.kernel, particle, distance2)
        if view.strategy == STRATEGY_HIT:
            t = accepted_hits(t, index, alpha, view, rays, first)
        for lane in range(LANES):
            start_t = traced.rays[lane].start_t
            if t[lane] < FAR and is_before(start_t, traced.rays[lane].start_index, t[lane], index):
                hit = Hit()
                hit.t = t[lane]
                hit.alpha = alpha[lane]
                hit.index = index
                keep_hit(
                    traced.hits, traced.rays[lane].kept, view.hits_kept, hit, traced.cut_t[lane], traced.cut_index[lane]
                )
                next_hit = traced.hits[traced.rays[lane].kept.head]
                traced.rays[lane].next_t = next_hit.t
                nearest = lesser(nearest, next_hit.t)
                if view.strategy == STRATEGY_HIT:
                    traced.cut_t[lane] = next_hit.t
                    traced.cut_index[lane] = next_hit.index
        return nearest

    @wp.kernel(module="unique", module_options=PACKET_OPTIONS)
    def trace_gaussians(
        start: int,
        settings: wp.array(dtype=TraceData),
        scene: SceneBvh,
        rays: RayData,
        limits: wp.array(dtype=float),
        radiance_out: GaussianHits,
    ):
        """Blends the Gaussians up to the end of each ray."""
        first = (start + wp.tid()) * LANES
        view = settings[0]
        for lane in range(LANES):
            radiance_out.depth[first + lane] = wp.inf
            store_pixel(radiance_out, first + lane, empty_pixel())
        waiting = ends_of(rays, limits, first)
        if largest(waiting) < 0.0:
            return

        traced_room = TracedRoom()
        traced = traced_in(traced_room)
        packet_room = RaysRoom()
        packet = rays_in(packet_room)
        stack_room = StackRoom()
        stack = stack_in(stack_room)
        leaves = ChildLinks()
        place = PacketPlace()
        while largest(waiting) > 0.0:
            begin_packet(packet, waiting, rays, first, scene.packet_radius)
            begin_rays(traced)
            again = bool(True)
            while again:
                begin = begin_pass(traced, packet, view)
                reach = largest(traced.cut_t)
                nearest = float(FAR)  # of the hits in the lists
                top = begin_traversal(stack, place)
                while top > 0:
                    top -= 1
                    if stack[top].entry <= reach:
                        number = stack[top].instance
                        if number != place.number:
                            enter_instance(place, packet, number, scene, rays, first)
                        leaf_count = visit_node(stack, top, leaves, place, scene, begin, reach, NEAR_FIRST)
                        for leaf in range(leaf_count):
                            particle = scene.assets[place.instance.asset].particles[leaves[leaf]]
                            first_t = keep_hits(traced, packet, particle, place.instance, view, rays, first)
                            if first_t < FAR:
                                nearest = lesser(nearest, first_t)
                                reach = largest(traced.cut_t)
                    # Hits before all nodes that wait are final. A stochastic hit is when none waits.
                    bound = float(FAR)
                    if top > 0:
                        bound = wp.where(view.strategy == STRATEGY_HIT, -FAR, stack[top - 1].floor)
                    if nearest < bound:
                        nearest = blend_final_hits(traced, packet, bound, view, scene, rays, first, radiance_out)
                        reach = largest(traced.cut_t)
                        if reach < 0.0:
                            top = int(0)
                again = view.strategy != STRATEGY_HIT and is_cut(traced, packet)
            for lane in range(LANES):
                if packet.limit[lane] > 0.0:
                    close_last_pass(traced.rays[lane], rays, first + lane, radiance_out)

    return trace_gaussians
