"""Packet tracing: intersection of rays with a Gaussian, hit lists, and blending of final hits.

The strategies differ in two places. STRATEGY_HIT accepts each hit at random before the hit enters the list, and the
list holds only one hit. STRATEGY_PASS decides at random, after every k blended hits, whether these are accepted
(docs/method/ray_tracing.md#strategies).
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from lumisplat.constants import HIT_BUFFER_CPU, HIT_BUFFER_CUDA
from lumisplat.device.bvh.nodes import first_lane, footprint_variance, larger, lesser
from lumisplat.device.bvh.packet import buffer_hit, empty_list, is_before, largest_of, least_of, packet_of
from lumisplat.device.gaussian.layers import is_other_layer, thin_axis, world_mean
from lumisplat.device.gaussian.particle import alpha_of_degree, surface_peak
from lumisplat.device.gaussian.ray_compositing import (
    blend_hit,
    close_pass,
    load_pixel,
    record_hit,
    store_pixel,
)
from lumisplat.device.math.memory import storage_of
from lumisplat.device.math.random import draw_mixed, mix
from lumisplat.device.splat.blending import add_relit, instance_of
from lumisplat.device.splat.projection import alpha_from_log
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import (
    FAR,
    HIT_HULL,
    HIT_MEAN,
    HIT_PEAK,
    STRATEGY_HIT,
    STRATEGY_PASS,
    Hit,
    HitList,
    PacketRays,
    Particle,
    SceneBvh,
    TraceData,
)
from lumisplat.device.structs.rays import GaussianHits, HitProfiles, Ray, RayData
from lumisplat.device.structs.scene import KernelData, SplatInstanceData

HIT_NONE: int = wp.constant(0)
HIT_FAR: int = wp.constant(1)
"""Kind of hit that always counts: the response peaks beyond the shadow offset or the ray's ``t_min``."""

HIT_NEAR: int = wp.constant(2)
"""Kind of hit: so close to the ray's origin that it counts only if the Gaussian is of another surface layer."""

COVER_MARGIN = 1e-3
"""Fraction of the smallest transmittance by which listed hits must be more opaque, so that none behind them matters.

It exceeds the rounding of products of many transmittances."""

PASS_REWIND = 1e-4
"""A new pass of a ray starts nearer than the last blended hit by this fraction of the hit's distance.

Rounding may place hits outside the box of their BVH node."""

# --- Intersection, and alpha of each hit (docs/method/ray_tracing.md#hits) ---


class PacketHits(NamedTuple):
    """Functions that intersect packets with Gaussians, generated for one number of rays per packet."""

    hit_distances: Any
    hit_responses: Any
    alphas_at: Any
    counted_hits: Any


@functools.cache
def packet_hits_of(lanes: int) -> PacketHits:
    """Builds the intersection functions for packets of up to ``lanes`` rays."""
    LANES = lanes
    Floats, Ints = packet_of(lanes).floats, packet_of(lanes).ints

    @wp.func
    def hit_distances(particle: Particle, scale: float, hit_distance: int, begin: float, packet: PacketRays):
        """Intersects each ray of a packet with a Gaussian, widened by the ray's footprint.

        Returns three values per ray: the distance by which hits are sorted (FAR without a hit), the squared canonical
        distance at the peak of the response, and HIT_NONE, HIT_FAR or HIT_NEAR. Hits peak before ``t_max``. A hit is
        HIT_NEAR if it peaks no farther than the smaller of ``t_min`` and ``begin``.
        """
        origin = packet.origin
        direction = packet.direction
        w = particle.canonical_from_object
        mean = particle.mean
        sharp_x = w[0, 0] * w[0, 0] + w[0, 1] * w[0, 1] + w[0, 2] * w[0, 2]
        sharp_y = w[1, 0] * w[1, 0] + w[1, 1] * w[1, 1] + w[1, 2] * w[1, 2]
        sharp_z = w[2, 0] * w[2, 0] + w[2, 1] * w[2, 1] + w[2, 2] * w[2, 2]
        per_length2 = scale * scale
        largest_scale = scale * particle.largest_scale
        t = Floats()
        distance2 = Floats()
        kind = Ints()
        for lane in range(LANES):
            x = origin[0, lane] - mean[0]
            y = origin[1, lane] - mean[1]
            z = origin[2, lane] - mean[2]
            cx = w[0, 0] * x + w[0, 1] * y + w[0, 2] * z
            cy = w[1, 0] * x + w[1, 1] * y + w[1, 2] * z
            cz = w[2, 0] * x + w[2, 1] * y + w[2, 2] * z
            ex = w[0, 0] * direction[0, lane] + w[0, 1] * direction[1, lane] + w[0, 2] * direction[2, lane]
            ey = w[1, 0] * direction[0, lane] + w[1, 1] * direction[1, lane] + w[1, 2] * direction[2, lane]
            ez = w[2, 0] * direction[0, lane] + w[2, 1] * direction[1, lane] + w[2, 2] * direction[2, lane]
            dx = direction[0, lane]
            dy = direction[1, lane]
            dz = direction[2, lane]
            middle = -(x * dx + y * dy + z * dz) * per_length2
            variance = footprint_variance(packet.footprint[lane], packet.path_length[lane] + middle, largest_scale)
            fx = 1.0 / (1.0 + variance * sharp_x)
            fy = 1.0 / (1.0 + variance * sharp_y)
            fz = 1.0 / (1.0 + variance * sharp_z)
            per_unit = 1.0 / wp.sqrt(fx * ex * ex + fy * ey * ey + fz * ez * ez)
            ex = ex * per_unit
            ey = ey * per_unit
            ez = ez * per_unit
            # By a cross product, because c + t e would cancel for thin Gaussians.
            kx = cy * ez - cz * ey
            ky = cz * ex - cx * ez
            kz = cx * ey - cy * ex
            # In this order, because products of two factors of thin axes leave float32.
            d2 = (fy * kx) * (fz * kx) + (fz * ky) * (fx * ky) + (fx * kz) * (fy * kz)
            peak = -(fx * cx * ex + fy * cy * ey + fz * cz * ez) * per_unit
            inside = particle.reach2 - d2
            back = wp.where(hit_distance == HIT_HULL, per_unit * wp.sqrt(larger(inside, 0.0)), 0.0)
            is_hit = wp.where(inside >= 0.0, 1, 0) & wp.where(peak > 0.0, 1, 0)
            is_hit = is_hit & wp.where(peak < packet.t_max[lane], 1, 0)
            kind[lane] = wp.where(peak > lesser(packet.t_min[lane], begin), HIT_FAR, HIT_NEAR) * is_hit
            t[lane] = wp.where(is_hit != 0, wp.where(hit_distance == HIT_MEAN, middle, peak - back), FAR)
            distance2[lane] = d2
        return t, distance2, kind

    @wp.func
    def hit_responses(particle: Particle, begin: float, packet: PacketRays):
        """Intersects each ray of a packet with a Gaussian, without footprints and without the hit distance.

        Returns HIT_NONE, HIT_FAR or HIT_NEAR per ray as ``hit_distances`` does, and numerator and denominator of the
        squared canonical distance, because most rays do not need their quotient.
        """
        origin = packet.origin
        direction = packet.direction
        w = particle.canonical_from_object
        mean = particle.mean
        kind = Ints()
        across2 = Floats()
        along2 = Floats()
        for lane in range(LANES):
            x = origin[0, lane] - mean[0]
            y = origin[1, lane] - mean[1]
            z = origin[2, lane] - mean[2]
            cx = w[0, 0] * x + w[0, 1] * y + w[0, 2] * z
            cy = w[1, 0] * x + w[1, 1] * y + w[1, 2] * z
            cz = w[2, 0] * x + w[2, 1] * y + w[2, 2] * z
            ex = w[0, 0] * direction[0, lane] + w[0, 1] * direction[1, lane] + w[0, 2] * direction[2, lane]
            ey = w[1, 0] * direction[0, lane] + w[1, 1] * direction[1, lane] + w[1, 2] * direction[2, lane]
            ez = w[2, 0] * direction[0, lane] + w[2, 1] * direction[1, lane] + w[2, 2] * direction[2, lane]
            kx = cy * ez - cz * ey
            ky = cz * ex - cx * ez
            kz = cx * ey - cy * ex
            k2 = kx * kx + ky * ky + kz * kz
            e2 = ex * ex + ey * ey + ez * ez
            peak = -(cx * ex + cy * ey + cz * ez)
            hit = wp.where(k2 <= particle.reach2 * e2, 1, 0) & wp.where(peak < packet.t_max[lane] * e2, 1, 0)
            hit = hit & wp.where(peak > 0.0, 1, 0)
            kind[lane] = wp.where(peak > lesser(packet.t_min[lane], begin) * e2, HIT_FAR, HIT_NEAR) * hit
            across2[lane] = k2
            along2[lane] = e2
        return kind, across2, along2

    @wp.func
    def alphas_at(kernel: KernelData, particle: Particle, distance2: Floats) -> Floats:
        """Returns the alphas of a Gaussian at squared canonical distances within its reach."""
        alpha = Floats()
        for lane in range(LANES):
            alpha[lane] = alpha_from_log(particle.log_opacity - 0.5 * distance2[lane])
        if kernel.degree != 2:
            for lane in range(LANES):
                alpha[lane] = alpha_of_degree(kernel, particle.log_opacity, distance2[lane])
        return alpha

    @wp.func
    def counted_hits(
        kind: wp.ref[Ints],
        begin: float,
        packet: PacketRays,
        particle: Particle,
        instance: SplatInstanceData,
        scene: SceneBvh,
        rays: RayData,
        first: int,
    ) -> int:
        """Turns each HIT_NEAR into HIT_NONE unless the Gaussian is of another layer than the ray's surface.

        Returns 0 if no ray has a hit left, else another number. ``kind`` has the kind of each ray's hit. ``begin`` is
        the distance up to which a response peak counts as near. ``first`` is the index of the packet's first ray in
        ``rays``.
        """
        found = int(0)
        for lane in range(LANES):
            found = found | kind[lane]
        if (found & HIT_NEAR) == 0:
            return found
        kinds = kind
        found = int(0)
        axis = thin_axis(particle, instance)
        if wp.length_sq(axis) == 0.0:
            for lane in range(LANES):
                kinds[lane] = kinds[lane] & HIT_FAR
                found = found | kinds[lane]
            kind = kinds
            return found
        mean = world_mean(particle, instance)
        gaussians = scene.assets[instance.asset].gaussians
        for lane in range(LANES):
            if kinds[lane] == HIT_NEAR:
                near = lesser(packet.t_min[lane], begin)
                if not is_other_layer(first + lane, near, mean, axis, particle, instance, gaussians, rays):
                    kinds[lane] = HIT_NONE
            found = found | kinds[lane]
        kind = kinds
        return found

    return PacketHits(hit_distances, hit_responses, alphas_at, counted_hits)


# --- Lists of hits, and their blending ---

REWIND = wp.constant(wp.float32(PASS_REWIND))

COVER = wp.constant(wp.float32(1.0 - COVER_MARGIN))


@struct
class RayProgress:
    """How far a ray is blended: its waiting hits, and the last blended hit."""

    hit_list: HitList
    """Hits found but not blended yet, because traversal may still find nearer ones."""
    next_t: float
    """Distance of the nearest hit in ``hit_list``; FAR: the list is empty."""
    start_t: float
    """Distance of the last hit blended in earlier passes, with index ``start_index``; this pass skips hits up to it."""
    start_index: int
    last_t: float
    """Distance of the farthest hit blended so far."""
    last_index: int
    transmittance: float
    """Transmittance behind all hits that are blended."""
    behind: float
    """Transmittance behind all hits that are blended or in ``hit_list``."""
    is_covered: int
    """1: the hits in ``hit_list`` end the ray, so that it needs no hits behind them and no further pass."""
    blended: int
    """STRATEGY_PASS: number of hits blended since the last random decision whether the ray ends."""


@struct
class TracedPacket:
    """Hit lists and blending progress of a packet's rays, one lane for each ray; arrays are local to the kernel."""

    rays: wp.array[RayProgress]
    hits: wp.array[Hit]
    """Hits of all rays; each lane owns an equal range, to which its hit list refers."""
    cut_t: wp.array[float]
    """Distance of the nearest hit that a full list had to drop; it and all farther hits wait for another pass.

    Ties are broken by ``cut_index``, the index of the dropped hit's Gaussian."""
    cut_index: wp.array[int]


@wp.func
def begin_ray_pass(progress: wp.ref[RayProgress], first_slot: int):
    """Empties a ray's hit list for a new traversal of the BVH that finds the hits behind the last blended one."""
    progress.hit_list = empty_list(first_slot)
    progress.next_t = FAR
    progress.start_t = progress.last_t
    progress.start_index = progress.last_index
    progress.behind = progress.transmittance
    progress.is_covered = 0


@wp.func
def ray_of(rays: RayData, i: int) -> Ray:
    """Returns ray ``i`` of the arrays as one struct."""
    ray = Ray()
    ray.origin = rays.origin[i]
    ray.direction = rays.direction[i]
    ray.t_min = rays.t_min[i]
    ray.path_length = rays.path_length[i]
    ray.spread = rays.spread[i]
    return ray


@wp.func
def surface_distance(scene: SceneBvh, ray: Ray, t_max: float, index: int, t: float) -> float:
    """Returns the distance, at least 0, at which a ray that hits Gaussian ``index`` meets the Gaussian's surface.

    With HIT_HULL, it is the hit distance ``t``; otherwise, the peak of the Gaussian's response. ``index`` counts over
    all splat instances.
    """
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
    """Blends those hits in the list of ray ``i`` that are nearer than ``bound``; no nearer hits can be found any more.

    Returns whether the ray is opaque afterwards. ``profiles``, if given, receives every blended hit.
    """
    ray = ray_of(rays, i)
    if config.offset < FAR:
        ray.t_min = 0.0  # small Gaussians count even before it
    pixel = load_pixel(radiance, i)
    is_opaque = bool(False)
    head = int(progress.hit_list.head)
    tail = int(progress.hit_list.tail)
    while head < tail and hits[head].t < bound:
        t = hits[head].t
        index = hits[head].index
        alpha = wp.where(config.strategy == STRATEGY_HIT, 1.0, hits[head].alpha)
        head += 1
        before = pixel
        pixel = blend_hit(pixel, config, scene, ray, index, alpha)
        if profiles:
            record_hit(profiles, i, pixel, t, index, alpha)
        if radiance.relit_weight:
            add_relit(radiance, i, scene.instances, before, pixel, index)
        if pixel.surface == index:
            radiance.depth[i] = surface_distance(scene, ray, t_max, index, t)
        # Rounding may deliver a hit after a farther one.
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
    progress.transmittance = pixel.transmittance
    progress.hit_list.head = head
    progress.next_t = FAR
    if head < tail:
        progress.next_t = hits[head].t
    else:
        progress.hit_list = empty_list(progress.hit_list.begin)
    return is_opaque


@wp.func
def end_at_cover(
    progress: wp.ref[RayProgress], hits: wp.array[Hit], alpha: float, dropped: Hit, transmittance_min: float
) -> Hit:
    """Removes hits that a ray cannot reach from its list, after a hit of this ``alpha`` was added to the list.

    Hits found later only make the ray end earlier. ``dropped`` is the hit that the full list had to drop.

    Returns:
        The last hit in the list, if the ray ends there at the latest; else a hit with distance FAR.
    """
    behind = progress.behind * (1.0 - alpha)
    if dropped.t < FAR:
        behind = behind / (1.0 - dropped.alpha)
    last = int(progress.hit_list.tail) - 1
    opaque = COVER * transmittance_min
    while last > progress.hit_list.head and behind <= opaque * (1.0 - hits[last].alpha):
        behind = behind / (1.0 - hits[last].alpha)
        last -= 1
    progress.hit_list.tail = last + 1
    progress.behind = behind
    cut = Hit()
    cut.t = FAR
    progress.is_covered = 0
    if behind <= opaque:
        progress.is_covered = 1
        cut = hits[last]
    return cut


@wp.func
def begin_rays(traced: TracedPacket):
    """Resets the blending progress of all rays of a packet."""
    for lane in range(traced.rays.shape[0]):
        traced.rays[lane].last_t = -FAR
        traced.rays[lane].last_index = -1
        traced.rays[lane].blended = 0
        traced.rays[lane].transmittance = 1.0


@wp.func
def end_of_hits(limit: float, scene: SceneBvh) -> float:
    """Returns the largest distance that a hit may have on a ray that ends at ``limit``.

    With HIT_MEAN it is FAR, because a Gaussian may respond before the limit although its mean lies behind it.
    """
    return wp.where(scene.hit_distance == HIT_MEAN and limit > 0.0, FAR, limit)


@wp.func
def begin_pass(traced: TracedPacket, packet: PacketRays, config: TraceData, scene: SceneBvh) -> float:
    """Begins a traversal of the BVH for the hits that earlier passes of a packet left.

    Returns the smallest distance at which a hit may count on any ray of the packet or of its group of CUDA threads.
    """
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
    """Blends those hits of all rays that are nearer than ``bound``; traversal can find no more hits nearer than that.

    Returns the distance of the nearest hit that is left in any list; FAR: none.
    """
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
    """Returns whether a list of the packet, or of its group of CUDA threads, dropped hits: another pass is due."""
    found = float(0.0)
    for lane in range(traced.rays.shape[0]):
        is_short = traced.cut_t[lane] < end_of_hits(packet.limit[lane], scene) and traced.rays[lane].is_covered == 0
        found = larger(found, wp.where(is_short, 1.0, 0.0))
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
    """STRATEGY_PASS: decides at random whether ray ``i`` ends at its last hits, if these are fewer than a full pass."""
    if progress.blended > 0:
        index = progress.last_index
        depth = surface_distance(scene, ray_of(rays, i), t_max, index, progress.last_t)
        pixel = close_pass(load_pixel(radiance, i), radiance, i, rays.sample_key[i], depth, index)
        store_pixel(radiance, i, pixel)


class PacketTracing(NamedTuple):
    """Warp types and functions that trace packets, generated for one number of rays per packet."""

    storage: Any
    """Struct type of the kernel's local variable that holds the memory of the arrays of a TracedPacket."""
    traced_packet: Any
    buffer_hits: Any


@functools.cache
def packet_tracing_of(lanes: int) -> PacketTracing:
    """Builds the tracing types and functions for packets of up to ``lanes`` rays."""
    LANES = lanes
    HITS = lanes * (HIT_BUFFER_CUDA if lanes == 1 else HIT_BUFFER_CPU)
    Floats, Ints = packet_of(lanes).floats, packet_of(lanes).ints
    hit_distances, alphas_at = packet_hits_of(lanes).hit_distances, packet_hits_of(lanes).alphas_at
    counted_hits = packet_hits_of(lanes).counted_hits

    @struct
    class TracedStorage:
        """Local variable of a kernel that holds the memory of the arrays of a TracedPacket."""

        rays: storage_of(RayProgress, lanes)
        hits: storage_of(Hit, HITS)
        cut_t: Floats
        cut_index: Ints

    @wp.func
    def traced_packet(storage: wp.ref[TracedStorage]) -> TracedPacket:
        """Returns a TracedPacket whose arrays point to the memory of the local variable ``storage``."""
        traced = TracedPacket()
        traced.rays = wp.array(ptr=wp.address_of(storage.rays), shape=(LANES,), dtype=RayProgress)
        traced.hits = wp.array(ptr=wp.address_of(storage.hits), shape=(HITS,), dtype=Hit)
        traced.cut_t = wp.array(ptr=wp.address_of(storage.cut_t), shape=(LANES,), dtype=float)
        traced.cut_index = wp.array(ptr=wp.address_of(storage.cut_index), shape=(LANES,), dtype=int)
        return traced

    @wp.func
    def hits_before_cut(traced: TracedPacket, t: wp.ref[Floats], kind: Ints, index: int) -> int:
        """Sets the distance to FAR for each ray that misses the Gaussian, or hits it from ``cut_t`` of its list on.

        Returns a bit mask of the rays that have a hit left.
        """
        found = int(0)
        distances = t
        for lane in range(LANES):
            is_kept = wp.where(is_before(distances[lane], index, traced.cut_t[lane], traced.cut_index[lane]), 1, 0)
            is_kept = is_kept & wp.where(kind[lane] != HIT_NONE, 1, 0)
            distances[lane] = wp.where(is_kept != 0, distances[lane], FAR)
            found = found | (is_kept << lane)
        t = distances
        return found

    @wp.func
    def accepted_hits(t: Floats, index: int, alpha: Floats, config: TraceData, rays: RayData, first: int) -> Floats:
        """STRATEGY_HIT: accepts each hit with probability alpha; returns its distance, or FAR if it is rejected."""
        dimension = mix(wp.uint32(index))
        for lane in range(LANES):
            number = draw_mixed(rays.sample_key[first + lane], dimension)
            t[lane] = wp.where(number * config.acceptance_scale < alpha[lane], t[lane], FAR)
        return t

    @wp.func
    def buffer_hits(
        traced: TracedPacket,
        packet: PacketRays,
        particle: Particle,
        instance: SplatInstanceData,
        config: TraceData,
        scene: SceneBvh,
        rays: RayData,
        first: int,
    ) -> float:
        """Adds each ray's hit with a Gaussian to the ray's sorted list; a full list drops its farthest hit.

        Returns the smallest distance of the nearest hit in a changed list; FAR: no list changed. ``first`` is the index
        of the packet's first ray in ``rays``.
        """
        index = instance.first + particle.index
        begin = float(FAR)
        if config.offset < FAR:
            begin = config.offset * instance.scale * particle.largest_scale + config.offset_absolute
        t, distance2, kind = hit_distances(particle, instance.scale, instance.hit_distance, begin, packet)
        nearest = float(FAR)
        if counted_hits(kind, begin, packet, particle, instance, scene, rays, first) == 0:
            return nearest
        found = int(hits_before_cut(traced, t, kind, index))
        if found == 0:
            return nearest
        alpha = alphas_at(instance.kernel, particle, distance2)
        if config.strategy == STRATEGY_HIT:
            t = accepted_hits(t, index, alpha, config, rays, first)
        while found != 0:
            lane = first_lane(found)
            found = found & (found - 1)
            start_t = traced.rays[lane].start_t
            if t[lane] < FAR and is_before(start_t, traced.rays[lane].start_index, t[lane], index):
                hit = Hit()
                hit.t = t[lane]
                hit.alpha = alpha[lane]
                hit.index = index
                dropped = buffer_hit(traced.hits, traced.rays[lane].hit_list, config.hit_buffer_size, hit)
                if dropped.t < FAR:
                    traced.cut_t[lane] = dropped.t
                    traced.cut_index[lane] = dropped.index
                if config.transmittance_min > 0.0:
                    cut = end_at_cover(traced.rays[lane], traced.hits, alpha[lane], dropped, config.transmittance_min)
                    if cut.t < FAR:
                        traced.cut_t[lane] = cut.t
                        traced.cut_index[lane] = cut.index
                next_hit = traced.hits[traced.rays[lane].hit_list.head]
                traced.rays[lane].next_t = next_hit.t
                nearest = lesser(nearest, next_hit.t)
                if config.strategy == STRATEGY_HIT:
                    traced.cut_t[lane] = next_hit.t
                    traced.cut_index[lane] = next_hit.index
        return nearest

    return PacketTracing(TracedStorage, traced_packet, buffer_hits)
