"""Tracing of a packet: the hits that its rays keep, and how these are blended once they are final.

The strategies differ in two places: a stochastic hit is drawn before it enters the list, which then holds one; and a
stochastic pass is drawn whenever k hits were blended (docs/method/ray_tracing.md#strategies).
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from lumisplat.constants import HITS_KEPT_CPU, HITS_KEPT_CUDA, PASS_REWIND
from lumisplat.device.bvh.hit_list import empty_list, is_before, keep_hit
from lumisplat.device.bvh.local_arrays import storage_of
from lumisplat.device.bvh.node_test import larger, lesser
from lumisplat.device.bvh.ray_group import largest_of, least_of
from lumisplat.device.bvh.ray_packet import packet_of
from lumisplat.device.gaussian.packet_hits import packet_hits_of
from lumisplat.device.gaussian.ray_compositing import blend_hit, close_pass, load_pixel, record_hit, store_pixel
from lumisplat.device.gaussian.surface_depth import surface_peak
from lumisplat.device.math.random import draw_mixed, mix
from lumisplat.device.splat.blending import add_relit, instance_of
from lumisplat.device.structs.bvh import (
    FAR,
    HIT_HULL,
    HIT_MEAN,
    HIT_NONE,
    HIT_PEAK,
    STRATEGY_HIT,
    STRATEGY_PASS,
    Particle,
    SceneBvh,
    TraceData,
)
from lumisplat.device.structs.declare import struct
from lumisplat.device.structs.packet import Hit, HitList, PacketRays
from lumisplat.device.structs.rays import GaussianHits, HitProfiles, Ray, RayData
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

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
    """A packet while it is traced, one lane a ray; local arrays of the kernel."""

    rays: wp.array[RayProgress]
    hits: wp.array[Hit]
    """The slots of the lists of all rays."""
    cut_t: wp.array[float]
    """Hits from (cut_t, cut_index) on are left to another pass."""
    cut_index: wp.array[int]


@wp.func
def begin_ray_pass(progress: wp.ref[RayProgress], first_slot: int):
    """Empties the list; hits count from behind the last one that was blended."""
    progress.kept = empty_list(first_slot)
    progress.next_t = FAR
    progress.start_t = progress.last_t
    progress.start_index = progress.last_index


@wp.func
def ray_of(rays: RayData, i: int) -> Ray:
    """Ray ``i``."""
    ray = Ray()
    ray.origin = rays.origin[i]
    ray.direction = rays.direction[i]
    ray.t_min = rays.t_min[i]
    ray.path_length = rays.path_length[i]
    ray.spread = rays.spread[i]
    return ray


@wp.func
def surface_distance(scene: SceneBvh, ray: Ray, t_max: float, index: int, t: float) -> float:
    """Distance of the surface of the Gaussian ``index`` of the scene, which a ray hits at ``t``; at least 0."""
    instance = scene.instances[instance_of(scene.instances, index)]
    if instance.hit_distance == HIT_HULL:
        return larger(t, 0.0)
    gaussians = scene.assets[instance.asset].gaussians
    i = index - instance.first
    scale = gaussians.scales[i]
    origin = instance.object_from_world * ray.origin + instance.object_from_world_offset
    along = instance.object_from_world * ray.direction
    away = gaussians.means[i] - origin
    middle = wp.dot(away, along) * instance.scale * instance.scale
    depth = surface_peak(gaussians.rotations[i], scale, away, along, middle, instance.scale * wp.max(scale))
    return wp.clamp(depth, ray.t_min, t_max)


@wp.func
def blend_hits(
    progress: wp.ref[RayProgress],
    hits: wp.array[Hit],
    bound: float,
    t_max: float,
    config: TraceData,
    scene: SceneBvh,
    rays: RayData,
    i: int,
    radiance: GaussianHits,
    profiles: wp.array[HitProfiles],
) -> bool:
    """Blends the hits of ray ``i`` that are nearer than ``bound``; returns whether it is opaque then."""
    ray = ray_of(rays, i)
    if config.offset < FAR:
        ray.t_min = 0.0  # small Gaussians count before it
    pixel = load_pixel(radiance, i)
    is_opaque = bool(False)
    head = int(progress.kept.head)
    tail = int(progress.kept.tail)
    while head < tail and hits[head].t < bound:
        t = hits[head].t
        index = hits[head].index
        alpha = wp.where(config.strategy == STRATEGY_HIT, 1.0, hits[head].alpha)
        head += 1
        before = pixel
        pixel = blend_hit(pixel, config, scene.instances, scene.assets, ray, index, alpha)
        if profiles:
            record_hit(profiles, i, pixel, t, index, alpha)
        if radiance.relit_weight:
            add_relit(radiance, i, scene.instances, before, pixel, index)
        if pixel.surface == index:
            radiance.depth[i] = surface_distance(scene, ray, t_max, index, t)
        # Rounding may deliver a hit after one that is farther.
        if is_before(progress.last_t, progress.last_index, t, index):
            progress.last_t = t
            progress.last_index = index
        if config.strategy == STRATEGY_PASS:
            progress.blended += 1
            if progress.blended == config.hits_per_pass:
                progress.blended = 0
                depth = surface_distance(scene, ray, t_max, index, t)
                pixel = close_pass(pixel, radiance, i, rays.sample_key[i], depth, index)
        if pixel.transmittance <= config.transmittance_min:
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
def end_of_hits(limit: float, scene: SceneBvh) -> float:
    """The distance before which a ray's hits are ordered; a mean may lie behind the limit before which it responds."""
    return wp.where(scene.hit_distance == HIT_MEAN and limit > 0.0, FAR, limit)


@wp.func
def begin_pass(traced: TracedPacket, packet: PacketRays, config: TraceData, scene: SceneBvh) -> float:
    """Begins a pass of all rays, also those of the group; returns the least distance at which a hit may count."""
    begin = float(FAR)
    slots = traced.hits.shape[0] // traced.rays.shape[0]
    for lane in range(traced.rays.shape[0]):
        begin_ray_pass(traced.rays[lane], lane * slots)
        traced.cut_t[lane] = end_of_hits(packet.limit[lane], scene)
        traced.cut_index[lane] = -1
        if packet.limit[lane] > 0.0:
            start = traced.rays[lane].start_t
            before = start - REWIND * wp.abs(start)
            from_t = wp.where(config.offset < FAR, 0.0, packet.t_min[lane])
            if scene.hit_distance == HIT_PEAK:
                before = larger(from_t, before)
            if scene.hit_distance == HIT_HULL:
                before = from_t
            begin = lesser(begin, before)
    return least_of(packet.group, begin)


@wp.func
def blend_final_hits(
    traced: TracedPacket,
    packet: PacketRays,
    bound: float,
    config: TraceData,
    scene: SceneBvh,
    rays: RayData,
    first: int,
    radiance: GaussianHits,
    profiles: wp.array[HitProfiles],
) -> float:
    """Blends the hits that are nearer than ``bound``; returns the distance of the nearest of the others."""
    nearest = float(FAR)
    for lane in range(traced.rays.shape[0]):
        if traced.rays[lane].next_t < bound:
            t_max = packet.t_max[lane]
            i = first + lane
            if blend_hits(traced.rays[lane], traced.hits, bound, t_max, config, scene, rays, i, radiance, profiles):
                packet.limit[lane] = -FAR
                traced.cut_t[lane] = -FAR
        nearest = lesser(nearest, traced.rays[lane].next_t)
    return nearest


@wp.func
def is_cut(traced: TracedPacket, packet: PacketRays, scene: SceneBvh) -> bool:
    """Whether a ray, also one of the group, has hits that are left to another pass."""
    found = float(0.0)
    for lane in range(traced.rays.shape[0]):
        found = larger(found, wp.where(traced.cut_t[lane] < end_of_hits(packet.limit[lane], scene), 1.0, 0.0))
    return largest_of(packet.group, found) > 0.0


@wp.func
def close_last_pass(
    progress: wp.ref[RayProgress],
    t_max: float,
    scene: SceneBvh,
    rays: RayData,
    i: int,
    radiance: GaussianHits,
):
    """Draws the last stochastic pass of ray ``i``, which has fewer hits."""
    if progress.blended > 0:
        index = progress.last_index
        depth = surface_distance(scene, ray_of(rays, i), t_max, index, progress.last_t)
        pixel = close_pass(load_pixel(radiance, i), radiance, i, rays.sample_key[i], depth, index)
        store_pixel(radiance, i, pixel)


class PacketTracing(NamedTuple):
    """Types and functions for a number of lanes."""

    storage: Any
    """The type of a variable in which a TracedPacket lies."""
    traced_packet: Any
    keep_hits: Any


@functools.cache
def packet_tracing_of(lanes: int) -> PacketTracing:
    """What tracing packets of up to ``lanes`` rays needs."""
    LANES = lanes
    HITS = lanes * (HITS_KEPT_CUDA if lanes == 1 else HITS_KEPT_CPU)
    Floats, Ints = packet_of(lanes).floats, packet_of(lanes).ints
    hit_distances, alphas_at = packet_hits_of(lanes).hit_distances, packet_hits_of(lanes).alphas_at
    counted_hits = packet_hits_of(lanes).counted_hits

    @struct
    class TracedStorage:
        """The variable in which a TracedPacket lies."""

        rays: storage_of(RayProgress, lanes)
        hits: storage_of(Hit, HITS)
        cut_t: Floats
        cut_index: Ints

    @wp.func
    def traced_packet(storage: wp.ref[TracedStorage]) -> TracedPacket:
        """The packet that lies in a variable."""
        traced = TracedPacket()
        traced.rays = wp.array(ptr=wp.address_of(storage.rays), shape=(LANES,), dtype=RayProgress)
        traced.hits = wp.array(ptr=wp.address_of(storage.hits), shape=(HITS,), dtype=Hit)
        traced.cut_t = wp.array(ptr=wp.address_of(storage.cut_t), shape=(LANES,), dtype=float)
        traced.cut_index = wp.array(ptr=wp.address_of(storage.cut_index), shape=(LANES,), dtype=int)
        return traced

    @wp.func
    def hits_before_cut(traced: TracedPacket, t: wp.ref[Floats], kind: Ints, index: int) -> int:
        """Replaces distances of hits that do not count, or lie behind their ray's cut, by FAR; whether any is left."""
        found = int(0)
        distances = t
        for lane in range(LANES):
            is_kept = wp.where(is_before(distances[lane], index, traced.cut_t[lane], traced.cut_index[lane]), 1, 0)
            is_kept = is_kept & wp.where(kind[lane] != HIT_NONE, 1, 0)
            distances[lane] = wp.where(is_kept != 0, distances[lane], FAR)
            found = found | is_kept
        t = distances
        return found

    @wp.func
    def accepted_hits(t: Floats, index: int, alpha: Floats, config: TraceData, rays: RayData, first: int) -> Floats:
        """Stochastic hits that are drawn with probability alpha, FAR for the others."""
        dimension = mix(wp.uint32(index))
        for lane in range(LANES):
            number = draw_mixed(rays.sample_key[first + lane], dimension)
            t[lane] = wp.where(number * config.acceptance_scale < alpha[lane], t[lane], FAR)
        return t

    @wp.func
    def keep_hits(
        traced: TracedPacket,
        packet: PacketRays,
        particle: Particle,
        instance: SplatInstanceData,
        config: TraceData,
        scene: SceneBvh,
        rays: RayData,
        first: int,
    ) -> float:
        """Adds the hits of a Gaussian to the lists of their rays; returns the distance of the nearest first hit."""
        index = instance.first + particle.index
        begin = float(FAR)
        if config.offset < FAR:
            begin = config.offset * instance.scale * particle.largest_scale + config.offset_absolute
        t, distance2, kind = hit_distances(particle, instance.scale, instance.hit_distance, begin, packet)
        nearest = float(FAR)
        if counted_hits(kind, begin, packet, particle, instance, scene, rays, first) == 0:
            return nearest
        found = hits_before_cut(traced, t, kind, index)
        if found == 0:
            return nearest
        alpha = alphas_at(instance.kernel, particle, distance2)
        if config.strategy == STRATEGY_HIT:
            t = accepted_hits(t, index, alpha, config, rays, first)
        for lane in range(LANES):
            start_t = traced.rays[lane].start_t
            if t[lane] < FAR and is_before(start_t, traced.rays[lane].start_index, t[lane], index):
                hit = Hit()
                hit.t = t[lane]
                hit.alpha = alpha[lane]
                hit.index = index
                dropped = keep_hit(traced.hits, traced.rays[lane].kept, config.hits_kept, hit)
                if dropped.t < FAR:
                    traced.cut_t[lane] = dropped.t
                    traced.cut_index[lane] = dropped.index
                next_hit = traced.hits[traced.rays[lane].kept.head]
                traced.rays[lane].next_t = next_hit.t
                nearest = lesser(nearest, next_hit.t)
                if config.strategy == STRATEGY_HIT:
                    traced.cut_t[lane] = next_hit.t
                    traced.cut_index[lane] = next_hit.index
        return nearest

    return PacketTracing(TracedStorage, traced_packet, keep_hits)
