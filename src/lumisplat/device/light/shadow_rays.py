"""Shadow rays: their start at interactions, and attenuation by surfaces and Gaussians.

The equations are in docs/method/shadows.md.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from lumisplat.constants import COLOR_STRENGTH_MAX, HIT_COUNTS
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

TINTED_TRANSMITTANCE_MIN = wp.constant(1e-30)
"""Lower bound of the transmittance of tinted shadow rays, which go on behind opaque Gaussians: their product must not
become 0, at which the traversal ends."""

# --- Origins of shadow rays ---


@wp.func
def leaves_below(j: int, direction: wp.vec3, wave: wp.array[WaveData]) -> bool:
    """Returns whether a ray that leaves interaction ``j`` in ``direction`` passes through its surface (rough glass)."""
    if not wave[0].interactions.transmitted:
        return False
    through = wp.dot(direction, wave[0].interactions.geometric_normal[j]) < 0.0
    return through and not is_black(wave[0].interactions.transmitted[j])


@wp.func
def spawn_origin(
    j: int, direction: wp.vec3, lift: wp.vec3, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> wp.vec3:
    """Returns the origin of a ray that leaves interaction ``j`` in ``direction``, moved off the surface to that side.

    ``lift`` is the result of ``spawn_lift``.
    """
    if leaves_below(j, direction, wave):
        stride = wave[0].interactions.exists.shape[0] // 2
        return mesh_spawn_point(j - stride, -wave[0].interactions.geometric_normal[j], scene, wave)
    return wave[0].interactions.spawn_point[j] + lift


@wp.func
def spawn_lift(j: int, direction: wp.vec3, wave: wp.array[WaveData]) -> wp.vec3:
    """Returns the vector that lifts a ray's origin from the spawn point of interaction ``j`` to the smooth surface.

    It is zero on Gaussians, and on meshes that are flat or that ``direction`` passes through.
    """
    height = wave[0].interactions.smooth_height[j]
    if height <= 0.0 or leaves_below(j, direction, wave):
        return wp.vec3(0.0)
    normal = wave[0].interactions.horizon_normal[j]
    return lift_of(height, normal, wave[0].interactions.geometric_normal[j], direction)


@wp.func
def reach_of(number: int, distance: float, scene: wp.array[ShadingScene]) -> float:
    """Returns where a shadow ray to a point of light ``number`` at this distance ends."""
    if number < scene[0].settings[0].light_count:  # else it is an emissive triangle
        return wp.min(distance, scene[0].lights[number].range)
    return distance


@wp.func
def write_shadow_ray(
    ray: int,
    number: int,
    origin: wp.vec3,
    t_min: float,
    normal: wp.vec3,
    towards: Contribution,
    scene: wp.array[ShadingScene],
    rays_out: RayData,
):
    """Writes shadow ray ``ray`` from a surface with unit ``normal`` to a point of light ``number``.

    The caller sets its random keys.
    """
    rays_out.is_active[ray] = True
    rays_out.origin[ray] = origin
    rays_out.direction[ray] = towards.direction
    rays_out.t_min[ray] = t_min
    rays_out.normal[ray] = normal
    rays_out.t_max[ray] = reach_of(number, towards.distance, scene)
    rays_out.path_length[ray] = 0.0
    rays_out.spread[ray] = 0.0


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
    """Writes shadow ray ``ray`` from interaction ``j`` to light ``number``; the caller sets its random keys."""
    origin = spawn_origin(j, contribution.direction, spawn_lift(j, contribution.direction, wave), scene, wave)
    towards = aimed_from_lifted_start(contribution, origin - wave[0].interactions.position[j])
    t_min = wave[0].interactions.spawn_t_min[j]
    write_shadow_ray(ray, number, origin, t_min, wave[0].interactions.geometric_normal[j], towards, scene, rays_out)


# --- Attenuation along a shadow ray ---


@wp.func
def shadow_key(settings: ShadowData) -> wp.uint32:
    """Returns the random key by which DRAWS_SHARED draws one number per Gaussian; 16 stratified samples share it."""
    return sample_key_of(-1, settings.sample // 16, settings.seed)


@wp.func
def shadow_floor(settings: ShadowData, pixel_key: wp.uint32, sample: int) -> float:
    """Returns the transmittance at which a shadow ray ends as blocked.

    It is the transmittance that counts as black. With DRAWS_PER_RAY it is a random number of the ray, stretched from
    0..1 to the threshold..1, so that the ray passes with the probability that the threshold leaves of the light.
    """
    if settings.draws == DRAWS_PER_RAY:
        return settings.threshold + (1.0 - settings.threshold) * sobol_2d(pixel_key, sample)[0]
    if settings.draws == DRAWS_SHARED:
        return 0.0
    return wp.max(settings.transmittance_min, settings.threshold)


@wp.func
def is_tinted(settings: ShadowData) -> bool:
    """Returns whether Gaussians tint shadows; rays then hit all Gaussians before the light, even once blocked."""
    return settings.color_strength > 0.0 and settings.draws != DRAWS_SHARED


@wp.func
def pass_straight(material: SmoothData, base_color: wp.vec3, cosine: float) -> wp.vec3:
    """Returns the linear transmittance of a mesh surface for shadow rays; 0 unless the surface is smooth glass.

    The ray passes straight, without refraction. Both sides therefore count as air: light that leaves the mesh has the
    Fresnel reflectance of light that enters it, and total internal reflection does not occur.
    """
    if material.smooth == 0:
        return wp.vec3(0.0)
    mirrored = material.specular * fresnel(cosine, 1.0 / material.ior)
    return (1.0 - mirrored) * (1.0 - material.metallic) * material.transmission * base_color


@wp.func
def tint_of(gaussians: GaussianData, i: int) -> wp.vec3:
    """Returns the linear, view-independent colour of Gaussian ``i``: its SH of degree 0."""
    return decode_srgb_color(sh_color(gaussians.sh, i * gaussians.sh_count, 0, wp.vec3(0.0)))


@wp.func
def add_tint(tint: wp.vec4, alpha: float, color: wp.vec3) -> wp.vec4:
    """Returns ``tint``, the sums of alpha times colour and of alpha, plus those of one more Gaussian."""
    return tint + alpha * wp.vec4(color[0], color[1], color[2], 1.0)


@wp.func
def shadow_of(settings: ShadowData, transmittance: float, floor: float, tint: wp.vec4) -> wp.vec3:
    """Returns the visibility of a light, per channel, after Gaussians reduced it to ``transmittance``.

    ``floor`` is the result of ``shadow_floor``; ``tint`` holds the sums, over the Gaussians on the ray, of alpha times
    linear colour and of alpha. See docs/method/shadows.md#threshold-and-tint.
    """
    if settings.draws == DRAWS_SHARED:
        return wp.vec3(wp.where(transmittance > 0.0, 1.0, 0.0))
    bright = wp.clamp((transmittance - settings.threshold) / (1.0 - settings.threshold), 0.0, 1.0)
    passed = wp.where(transmittance > floor, bright, 0.0)
    blocked = 1.0 - bright
    if settings.draws == DRAWS_PER_RAY:
        passed = wp.where(transmittance > floor, 1.0, 0.0)
        blocked = 1.0 - passed
    color = wp.vec3(tint[0], tint[1], tint[2])
    largest = wp.max(color)
    if settings.color_strength <= 0.0 or largest <= 0.0:
        return wp.vec3(passed)
    share = wp.min(settings.color_strength * (1.0 - bright), 1.0)
    filtered = passed * wp.lerp(wp.vec3(1.0), color / largest, share)
    glow = settings.color_strength / COLOR_STRENGTH_MAX * wp.min(color / tint[3], wp.vec3(1.0))
    return filtered + blocked * glow


# --- Shadows of a packet: attenuation by all Gaussians, or by the first hits only ---


@struct
class Absorption:
    """Transmittance and tint of the shadow rays of a packet, one lane for each ray; arrays are local to the kernel."""

    transmittance: wp.array[float]
    """Transmittance of each ray through the Gaussians found so far; 0 for blocked rays and unused lanes."""
    floor: wp.array[float]
    """Transmittance at or below which each ray counts as blocked; FAR for unused lanes."""
    tint: wp.array(dtype=float, ndim=2)
    """Sums over the Gaussians that each ray hit: rows red, green and blue of alpha times linear colour, and alpha; one
    column for each lane."""


@struct
class FirstHits:
    """Lists of the nearest hits of a packet's shadow rays, one lane for each ray; arrays are local to the kernel."""

    lists: wp.array[HitList]
    hits: wp.array[Hit]
    """Hits of all rays; each lane owns an equal range, to which its hit list refers."""
    cut_t: wp.array[float]
    """Distance of the farthest hit in each ray's list once it is full; hits from (cut_t, cut_index) on are ignored.

    FAR: the list has free space."""
    cut_index: wp.array[int]


@wp.func
def begin_absorption(absorption: Absorption, packet: PacketRays, config: ShadowData, rays: RayData, first: int):
    """Resets the attenuation of all rays of a packet."""
    for lane in range(absorption.transmittance.shape[0]):
        is_taken = packet.limit[lane] > 0.0
        absorption.transmittance[lane] = wp.where(is_taken, 1.0, 0.0)
        absorption.floor[lane] = FAR
        if is_taken:
            absorption.floor[lane] = shadow_floor(config, rays.pixel_key[first + lane], rays.sample[first + lane])
        for k in range(4):
            absorption.tint[k, lane] = 0.0


@wp.func
def begin_first_hits(first_hits: FirstHits):
    """Empties the hit lists of all rays of a packet."""
    lanes = first_hits.lists.shape[0]
    for lane in range(lanes):
        first_hits.lists[lane] = empty_list(lane * (first_hits.hits.shape[0] // lanes))
        first_hits.cut_t[lane] = FAR
        first_hits.cut_index[lane] = -1


@wp.func
def end_rays(packet: PacketRays, tree: PacketTree, skips: wp.array[wp.bool], first: int) -> float:
    """Sets ``t_max`` of the rays before a packet enters a tree: the ray's end, or -FAR if the ray skips the tree.

    A ray with ``skips`` skips trees of shadow catchers. Returns the largest ``t_max``, at least -FAR; nodes farther
    away need not be visited.
    """
    is_shadow_only = tree.number != WORLD and tree.instance.shadow_catcher != 0
    reach = float(-FAR)
    for lane in range(packet.t_max.shape[0]):
        is_skipped = is_shadow_only and skips[first + lane]
        packet.t_max[lane] = wp.where(is_skipped, -FAR, packet.limit[lane])
        reach = larger(reach, packet.t_max[lane])
    return reach


@wp.func
def shadow_begin(config: ShadowData, particle: Particle, instance: SplatInstanceData) -> float:
    """Returns the shadow offset of a Gaussian, scene units: the Gaussian does not shadow surfaces nearer than this.

    A smaller shadow offset of the surface takes precedence.
    """
    return config.offset * instance.scale * particle.largest_scale + config.offset_absolute


@wp.func
def farthest_reach(first_hits: FirstHits, packet: PacketRays) -> float:
    """Returns the largest distance at which any ray of a packet can still take a hit into its list of first hits."""
    reach = float(-FAR)
    for lane in range(first_hits.cut_t.shape[0]):
        reach = larger(reach, lesser(first_hits.cut_t[lane], packet.limit[lane]))
    return reach


@wp.func
def shadow_of_list(config: ShadowData, scene: SceneBvh, hits: wp.array[Hit], hit_list: HitList) -> wp.vec3:
    """Returns the visibility of a light, per channel, through the Gaussians whose hits are in ``hit_list``."""
    transmittance = float(1.0)
    tint = wp.vec4()
    for j in range(hit_list.head, hit_list.tail):
        alpha = hits[j].alpha
        transmittance = transmittance * (1.0 - alpha)
        if config.color_strength > 0.0:
            index = hits[j].index
            instance = scene.instances[instance_of(scene.instances, index)]
            tint = add_tint(tint, alpha, tint_of(scene.assets[instance.asset].gaussians, index - instance.first))
    return shadow_of(config, transmittance, wp.max(config.transmittance_min, config.threshold), tint)


class PacketAbsorption(NamedTuple):
    """Warp types and functions for shadows by all Gaussians, generated for one number of rays per packet."""

    storage: Any
    """Struct type of the kernel's local variable that holds the memory of the arrays of an Absorption."""
    absorption_of: Any
    absorb: Any


class PacketFirstHits(NamedTuple):
    """Warp types and functions for shadows by the nearest Gaussians, generated for one number of rays per packet."""

    storage: Any
    """Struct type of the kernel's local variable that holds the memory of the arrays of FirstHits."""
    first_hits_of: Any
    buffer_first_hits: Any


@functools.cache
def packet_absorption_of(lanes: int) -> PacketAbsorption:
    """Builds types and functions for shadows by all Gaussians, for packets of up to ``lanes`` rays."""
    LANES = lanes
    Floats, Vec4s = packet_of(lanes).floats, wp.types.matrix(shape=(4, lanes), dtype=wp.float32)
    hit_responses, alphas_at = packet_hits_of(lanes).hit_responses, packet_hits_of(lanes).alphas_at
    counted_hits = packet_hits_of(lanes).counted_hits

    @struct
    class AbsorptionStorage:
        """Local variable of a kernel that holds the memory of the arrays of an Absorption."""

        transmittance: Floats
        floor: Floats
        tint: Vec4s

    @wp.func
    def absorption_of(storage: wp.ref[AbsorptionStorage]) -> Absorption:
        """Returns an Absorption whose arrays point to the memory of the local variable ``storage``."""
        absorption = Absorption()
        absorption.transmittance = wp.array(ptr=wp.address_of(storage.transmittance), shape=(LANES,), dtype=float)
        absorption.floor = wp.array(ptr=wp.address_of(storage.floor), shape=(LANES,), dtype=float)
        absorption.tint = wp.array(ptr=wp.address_of(storage.tint), shape=(4, LANES), dtype=float)
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
        """Multiplies the transmittance of the packet's rays by a Gaussian's, and ends the rays that become blocked.

        Returns 1 if any ray hits the Gaussian, else 0. ``first`` is the index of the packet's first ray in ``rays``,
        ``key`` the key of shared random numbers.
        """
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
        lowest = wp.where(is_tinted(config), TINTED_TRANSMITTANCE_MIN, 0.0)
        for lane in range(LANES):
            alpha[lane] = wp.where(kind[lane] != HIT_NONE, alpha[lane], 0.0)
            passed = wp.max(absorption.transmittance[lane] * (1.0 - alpha[lane]), lowest)
            is_blocked = passed <= absorption.floor[lane] and lowest <= 0.0
            absorption.transmittance[lane] = wp.where(is_blocked, 0.0, passed)
            packet.limit[lane] = wp.where(is_blocked, -FAR, packet.limit[lane])
            packet.t_max[lane] = wp.where(is_blocked, -FAR, packet.t_max[lane])
        if is_tinted(config):
            color = tint_of(scene.assets[instance.asset].gaussians, particle.index)
            for lane in range(LANES):
                for k in range(3):
                    absorption.tint[k, lane] = absorption.tint[k, lane] + alpha[lane] * color[k]
                absorption.tint[3, lane] = absorption.tint[3, lane] + alpha[lane]
        return 1

    return PacketAbsorption(AbsorptionStorage, absorption_of, absorb)


@functools.cache
def packet_first_hits_of(lanes: int) -> PacketFirstHits:
    """Builds types and functions for shadows by the nearest Gaussians, for packets of up to ``lanes`` rays."""
    LANES = lanes
    HITS = lanes * HIT_COUNTS[-1]
    Floats, Ints = packet_of(lanes).floats, packet_of(lanes).ints
    hit_distances, alphas_at = packet_hits_of(lanes).hit_distances, packet_hits_of(lanes).alphas_at
    counted_hits = packet_hits_of(lanes).counted_hits

    @struct
    class FirstHitsStorage:
        """Local variable of a kernel that holds the memory of the arrays of FirstHits."""

        lists: storage_of(HitList, lanes)
        hits: storage_of(Hit, HITS)
        cut_t: Floats
        cut_index: Ints

    @wp.func
    def first_hits_of(storage: wp.ref[FirstHitsStorage]) -> FirstHits:
        """Returns FirstHits whose arrays point to the memory of the local variable ``storage``."""
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
        """Adds each ray's hit with a Gaussian to the ray's list of nearest hits; a full list drops its farthest hit.

        Returns 1 if any ray hits the Gaussian, else 0. ``first`` is the index of the packet's first ray in ``rays``.
        """
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
