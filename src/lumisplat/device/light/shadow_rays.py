"""Shadow rays: how they leave interactions, and how much light surfaces and Gaussians on them absorb.

The equations are in docs/method/shadows.md.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from lumisplat.constants import HIT_COUNTS
from lumisplat.device.bvh.nodes import larger, lesser
from lumisplat.device.bvh.packet import empty_list, insert_hit, is_before, packet_of
from lumisplat.device.gaussian.packet_tracing import HIT_NONE, packet_hits_of
from lumisplat.device.light.interaction import aimed_from_lifted_start, lift_of, mesh_spawn_point
from lumisplat.device.material.microfacets import fresnel
from lumisplat.device.math.color import decode_srgb_color, is_black
from lumisplat.device.math.memory import storage_of
from lumisplat.device.math.random import draw_stratified, sample_key_of, sobol_2d
from lumisplat.device.math.sh import sh_color
from lumisplat.device.splat.blending import instance_of
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import (
    DRAWS_NONE,
    DRAWS_PER_RAY,
    DRAWS_SHARED,
    FAR,
    WORLD,
    Hit,
    HitList,
    PacketRays,
    PacketTree,
    Particle,
    SceneBvh,
    ShadowData,
)
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import GaussianData, SmoothData, SplatInstanceData
from lumisplat.device.structs.shading import Contribution, ShadingScene, WaveData

# --- Origins of shadow rays ---


@wp.func
def leaves_below(j: int, direction: wp.vec3, wave: wp.array[WaveData]) -> bool:
    """Whether a ray from interaction ``j`` leaves through its surface."""
    if not wave[0].interactions.transmitted:
        return False
    through = wp.dot(direction, wave[0].interactions.geometric_normal[j]) < 0.0
    return through and not is_black(wave[0].interactions.transmitted[j])


@wp.func
def spawn_origin(
    j: int, direction: wp.vec3, lift: wp.vec3, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> wp.vec3:
    """Where a ray from interaction ``j`` begins, on the side to which it leaves; ``lift`` as ``spawn_lift``."""
    if leaves_below(j, direction, wave):
        stride = wave[0].interactions.exists.shape[0] // 2
        return mesh_spawn_point(j - stride, -wave[0].interactions.geometric_normal[j], scene, wave)
    return wave[0].interactions.spawn_point[j] + lift


@wp.func
def spawn_lift(j: int, direction: wp.vec3, wave: wp.array[WaveData]) -> wp.vec3:
    """From the spawn point of interaction ``j`` to where a ray begins: on the smooth surface, where that is above."""
    height = wave[0].interactions.smooth_height[j]
    if height <= 0.0 or leaves_below(j, direction, wave):
        return wp.vec3(0.0)
    normal = wave[0].interactions.horizon_normal[j]
    return lift_of(height, normal, wave[0].interactions.geometric_normal[j], direction)


@wp.func
def start_shadow_ray(
    ray: int,
    j: int,
    number: int,
    contribution: Contribution,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays_out: RayData,
):
    """Starts a shadow ray from interaction ``j`` towards light ``number``; its keys are left to the caller."""
    origin = spawn_origin(j, contribution.direction, spawn_lift(j, contribution.direction, wave), scene, wave)
    contribution = aimed_from_lifted_start(contribution, origin - wave[0].interactions.position[j])
    rays_out.is_active[ray] = True
    rays_out.origin[ray] = origin
    rays_out.direction[ray] = contribution.direction
    rays_out.t_min[ray] = wave[0].interactions.spawn_t_min[j]
    rays_out.normal[ray] = wave[0].interactions.geometric_normal[j]
    rays_out.t_max[ray] = contribution.distance
    if number < scene[0].settings[0].light_count:  # else it is one of triangles that shine
        rays_out.t_max[ray] = wp.min(contribution.distance, scene[0].lights[number].range)
    rays_out.path_length[ray] = 0.0
    rays_out.spread[ray] = 0.0


# --- Attenuation of light on a shadow ray ---


@wp.func
def shadow_key(settings: ShadowData) -> wp.uint32:
    """Key of the random numbers that all rays of a stochastic sample share."""
    return sample_key_of(-1, settings.sample // 16, settings.seed)


@wp.func
def shadow_floor(settings: ShadowData, pixel_key: wp.uint32, sample: int) -> float:
    """Transmittance down to which a ray is followed: where it counts as black; by a number a ray, that number."""
    if settings.draws == DRAWS_PER_RAY:
        return sobol_2d(pixel_key, sample)[0]
    if settings.draws == DRAWS_SHARED:
        return 0.0
    return wp.max(settings.transmittance_min, settings.threshold)


@wp.func
def passed_share(settings: ShadowData, transmittance: float) -> float:
    """The transmittance of a ray that came through; 1 or 0 if it was blocked wholly or not at all."""
    if settings.draws == DRAWS_NONE:
        return transmittance
    return wp.where(transmittance > 0.0, 1.0, 0.0)


@wp.func
def pass_straight(material: SmoothData, base_color: wp.vec3, cosine: float) -> wp.vec3:
    """Share of light that crosses a surface, linear; 0 unless it is smooth and transmits.

    The ray goes straight on, without refraction. Both sides therefore count as air: light that leaves the mesh has the
    Fresnel reflectance of light that enters it, and total internal reflection does not occur.
    """
    if material.smooth == 0:
        return wp.vec3(0.0)
    mirrored = material.specular * fresnel(cosine, 1.0 / material.ior)
    return (1.0 - mirrored) * (1.0 - material.metallic) * material.transmission * base_color


@wp.func
def tint_of(gaussians: GaussianData, i: int) -> wp.vec3:
    """Linear, view-independent colour of Gaussian ``i``: its SH of degree 0."""
    return decode_srgb_color(sh_color(gaussians.sh, i * gaussians.sh_count, 0, wp.vec3(0.0)))


@wp.func
def shadow_of(settings: ShadowData, transmittance: float, tint: wp.vec3) -> wp.vec3:
    """Visibility of a light through Gaussians: the factor of each channel.

    ``tint``: sum of their linear colours, weighted by alpha; its scale is irrelevant.
    """
    if transmittance <= wp.max(settings.transmittance_min, settings.threshold):
        return wp.vec3(0.0)
    bright = wp.min((transmittance - settings.threshold) / (1.0 - settings.threshold), 1.0)
    share = wp.min(settings.color_strength * (1.0 - bright), 1.0)
    largest = wp.max(tint)
    if share <= 0.0 or largest <= 0.0:
        return wp.vec3(bright)
    return bright * wp.lerp(wp.vec3(1.0), tint / largest, share)


# --- Shadows of a packet: what Gaussians absorb, all of them or only the first hits ---


@struct
class Absorption:
    """What a packet has passed so far, one lane a ray; local arrays of the kernel."""

    transmittance: wp.array[float]
    """0 for rays that are blocked, and for those that are not of the packet."""
    floor: wp.array[float]
    """A ray is blocked as soon as its transmittance falls to this; FAR for rays that are not of the packet."""
    tint: wp.array(dtype=float, ndim=2)
    """Sum of linear colours, weighted by alpha: red, green and blue by lane."""


@struct
class FirstHits:
    """The nearest hits of a packet, one lane a ray; local arrays of the kernel."""

    lists: wp.array[HitList]
    hits: wp.array[Hit]
    """The slots of the lists of all rays."""
    cut_t: wp.array[float]
    """Hits from (cut_t, cut_index) on do not count."""
    cut_index: wp.array[int]


@wp.func
def begin_absorption(absorption: Absorption, packet: PacketRays, config: ShadowData, rays: RayData, first: int):
    """Nothing absorbed yet."""
    for lane in range(absorption.transmittance.shape[0]):
        is_taken = packet.limit[lane] > 0.0
        absorption.transmittance[lane] = wp.where(is_taken, 1.0, 0.0)
        absorption.floor[lane] = FAR
        if is_taken:
            absorption.floor[lane] = shadow_floor(config, rays.pixel_key[first + lane], rays.sample[first + lane])
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
def end_rays(packet: PacketRays, tree: PacketTree, skips: wp.array[wp.bool], first: int) -> float:
    """Lets the Gaussians of a tree count up to the rays' limits; on rays that skip its instance, none of them does.

    Returns the farthest distance at which one counts, at least -FAR: nodes farther away need not be visited.
    """
    is_shadow_only = tree.number != WORLD and tree.instance.shadow_only != 0
    reach = float(-FAR)
    for lane in range(packet.t_max.shape[0]):
        is_skipped = is_shadow_only and skips[first + lane]
        packet.t_max[lane] = wp.where(is_skipped, -FAR, packet.limit[lane])
        reach = larger(reach, packet.t_max[lane])
    return reach


@wp.func
def shadow_begin(config: ShadowData, particle: Particle, instance: SplatInstanceData) -> float:
    """The distance from which on a Gaussian shadows a surface of wider Gaussians."""
    return config.offset * instance.scale * particle.largest_scale + config.offset_absolute


@wp.func
def farthest_reach(first_hits: FirstHits, packet: PacketRays) -> float:
    """The largest distance at which a hit may count."""
    reach = float(-FAR)
    for lane in range(first_hits.cut_t.shape[0]):
        reach = larger(reach, lesser(first_hits.cut_t[lane], packet.limit[lane]))
    return reach


@wp.func
def shadow_of_list(config: ShadowData, scene: SceneBvh, hits: wp.array[Hit], hit_list: HitList) -> wp.vec3:
    """Factor of the light that comes through the hits of a list."""
    transmittance = float(1.0)
    tint = wp.vec3()
    for j in range(hit_list.head, hit_list.tail):
        alpha = hits[j].alpha
        transmittance = transmittance * (1.0 - alpha)
        if config.color_strength > 0.0:
            index = hits[j].index
            instance = scene.instances[instance_of(scene.instances, index)]
            tint += alpha * tint_of(scene.assets[instance.asset].gaussians, index - instance.first)
    return shadow_of(config, transmittance, tint)


class PacketAbsorption(NamedTuple):
    """Types and functions for a number of lanes."""

    storage: Any
    """The type of a variable in which an Absorption lies."""
    absorption_of: Any
    absorb: Any


class PacketFirstHits(NamedTuple):
    """Types and functions for a number of lanes."""

    storage: Any
    """The type of a variable in which FirstHits lie."""
    first_hits_of: Any
    buffer_first_hits: Any


@functools.cache
def packet_absorption_of(lanes: int) -> PacketAbsorption:
    """What shadows by all Gaussians on packets of up to ``lanes`` rays need."""
    LANES = lanes
    Floats, Vec3s = packet_of(lanes).floats, packet_of(lanes).vec3s
    hit_responses, alphas_at = packet_hits_of(lanes).hit_responses, packet_hits_of(lanes).alphas_at
    counted_hits = packet_hits_of(lanes).counted_hits

    @struct
    class AbsorptionStorage:
        """The variable in which an Absorption lies."""

        transmittance: Floats
        floor: Floats
        tint: Vec3s

    @wp.func
    def absorption_of(storage: wp.ref[AbsorptionStorage]) -> Absorption:
        """What lies in a variable."""
        absorption = Absorption()
        absorption.transmittance = wp.array(ptr=wp.address_of(storage.transmittance), shape=(LANES,), dtype=float)
        absorption.floor = wp.array(ptr=wp.address_of(storage.floor), shape=(LANES,), dtype=float)
        absorption.tint = wp.array(ptr=wp.address_of(storage.tint), shape=(3, LANES), dtype=float)
        return absorption

    @wp.func
    def absorb(
        absorption: Absorption,
        packet: PacketRays,
        particle: Particle,
        instance: SplatInstanceData,
        config: ShadowData,
        scene: SceneBvh,
        rays: RayData,
        first: int,
        key: wp.uint32,
    ) -> int:
        """Adds what a Gaussian absorbs, and ends the rays that it blocks; returns 1 if a ray hits it, else 0."""
        begin = shadow_begin(config, particle, instance)
        kind, across2, along2 = hit_responses(particle, begin, packet)
        found = counted_hits(kind, begin, packet, particle, instance, scene, rays, first)
        if found == 0:
            return 0
        distance2 = Floats()
        for lane in range(LANES):
            distance2[lane] = across2[lane] / along2[lane]
        alpha = alphas_at(instance.kernel, particle, distance2)
        if config.draws == DRAWS_SHARED:
            number = config.acceptance_scale * draw_stratified(key, config.sample, instance.first + particle.index)
            for lane in range(LANES):
                alpha[lane] = wp.where(number < alpha[lane], 1.0, 0.0)
        if config.draws == DRAWS_PER_RAY:
            for lane in range(LANES):
                alpha[lane] = lesser(alpha[lane] / config.acceptance_scale, 1.0)
        for lane in range(LANES):
            alpha[lane] = wp.where(kind[lane] != HIT_NONE, alpha[lane], 0.0)
            passed = absorption.transmittance[lane] * (1.0 - alpha[lane])
            is_blocked = passed <= absorption.floor[lane]
            absorption.transmittance[lane] = wp.where(is_blocked, 0.0, passed)
            packet.limit[lane] = wp.where(is_blocked, -FAR, packet.limit[lane])
            packet.t_max[lane] = wp.where(is_blocked, -FAR, packet.t_max[lane])
        if config.color_strength > 0.0 and config.draws == DRAWS_NONE:
            color = tint_of(scene.assets[instance.asset].gaussians, particle.index)
            for lane in range(LANES):
                for k in range(3):
                    absorption.tint[k, lane] = absorption.tint[k, lane] + alpha[lane] * color[k]
        return 1

    return PacketAbsorption(AbsorptionStorage, absorption_of, absorb)


@functools.cache
def packet_first_hits_of(lanes: int) -> PacketFirstHits:
    """What shadows by the nearest Gaussians on packets of up to ``lanes`` rays need."""
    LANES = lanes
    HITS = lanes * HIT_COUNTS[-1]
    Floats, Ints = packet_of(lanes).floats, packet_of(lanes).ints
    hit_distances, alphas_at = packet_hits_of(lanes).hit_distances, packet_hits_of(lanes).alphas_at
    counted_hits = packet_hits_of(lanes).counted_hits

    @struct
    class FirstHitsStorage:
        """The variable in which FirstHits lie."""

        lists: storage_of(HitList, lanes)
        hits: storage_of(Hit, HITS)
        cut_t: Floats
        cut_index: Ints

    @wp.func
    def first_hits_of(storage: wp.ref[FirstHitsStorage]) -> FirstHits:
        """The hits that lie in a variable."""
        first_hits = FirstHits()
        first_hits.lists = wp.array(ptr=wp.address_of(storage.lists), shape=(LANES,), dtype=HitList)
        first_hits.hits = wp.array(ptr=wp.address_of(storage.hits), shape=(HITS,), dtype=Hit)
        first_hits.cut_t = wp.array(ptr=wp.address_of(storage.cut_t), shape=(LANES,), dtype=float)
        first_hits.cut_index = wp.array(ptr=wp.address_of(storage.cut_index), shape=(LANES,), dtype=int)
        return first_hits

    @wp.func
    def buffer_first_hits(
        first_hits: FirstHits,
        packet: PacketRays,
        particle: Particle,
        instance: SplatInstanceData,
        config: ShadowData,
        scene: SceneBvh,
        rays: RayData,
        first: int,
    ) -> int:
        """Adds the hits of a Gaussian to the lists of their rays; returns 1 if a ray hits it, else 0."""
        begin = shadow_begin(config, particle, instance)
        t, distance2, kind = hit_distances(particle, instance.scale, config.hit_distance, begin, packet)
        found = counted_hits(kind, begin, packet, particle, instance, scene, rays, first)
        if found == 0:
            return 0
        alpha = alphas_at(instance.kernel, particle, distance2)
        hit = Hit()
        hit.index = instance.first + particle.index
        for lane in range(LANES):
            if kind[lane] != HIT_NONE and is_before(
                t[lane], hit.index, first_hits.cut_t[lane], first_hits.cut_index[lane]
            ):
                hit.t = t[lane]
                hit.alpha = alpha[lane]
                # The farthest hit of a full list is the cut, so this one is nearer.
                hit_list = first_hits.lists[lane]
                end = hit_list.begin + config.hits
                if hit_list.tail == end:
                    hit_list.tail -= 1
                insert_hit(first_hits.hits, hit_list, hit)
                first_hits.lists[lane] = hit_list
                if hit_list.tail == end:
                    first_hits.cut_t[lane] = first_hits.hits[end - 1].t
                    first_hits.cut_index[lane] = first_hits.hits[end - 1].index
        return 1

    return PacketFirstHits(FirstHitsStorage, first_hits_of, buffer_first_hits)
