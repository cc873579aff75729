"""Kernels that trace camera rays through the Gaussians listed for their image tile, without a BVH.

A Gaussian is projected once a frame: to the rectangle of blocks (squares of 16 rays) that may hit it, and to a lower
bound of its hit distance on any ray. The lists of tiles are sorted by this bound. A ray that goes through its list
knows that hits nearer than the next bound are final, and blends them at once. Hits, their order and their blending are
those of ``gaussian_trace_kernels``.

The equations are in docs/method/ray_tracing.md#tiles.
"""

import functools
from typing import Any

import warp as wp

from lumisplat.constants import PACKET_RAYS
from lumisplat.device.bvh.nodes import lesser
from lumisplat.device.bvh.packet import PACKET_BOUNDS, PACKET_OPTIONS, packet_of
from lumisplat.device.gaussian.candidates import TILE_BLOCKS
from lumisplat.device.gaussian.packet_tracing import (
    begin_pass,
    begin_rays,
    blend_final_hits,
    close_last_pass,
    is_cut,
    packet_tracing_of,
)
from lumisplat.device.gaussian.particle import load_particle
from lumisplat.device.gaussian.ray_compositing import store_pixel
from lumisplat.device.math.memory import aligned_load_of, prefetch_of
from lumisplat.device.splat.blending import begin_relit, empty_pixel
from lumisplat.device.structs.bvh import (
    FAR,
    STRATEGY_HIT,
    Candidate,
    CandidateLists,
    Particle,
    SceneBvh,
    TraceData,
)
from lumisplat.device.structs.rays import GaussianHits, HitProfiles, RayData
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options(PACKET_OPTIONS)

BLEND_STEP, BLEND_STEP_CUDA = 32, 16
"""Number of entries of a list after which final hits are blended, because loading and storing a pixel takes longer than
blending a hit; half of the longest list of hits."""

CANDIDATES_AHEAD = wp.constant(12)
"""Number of entries between the one that is tested and the one whose candidate is prefetched."""

PARTICLES_AHEAD = wp.constant(6)
"""Number of entries between the one that is tested and the one whose particle is prefetched. Only entries that are
not skipped need their particles."""

SETS_ALL: int = wp.constant(0)

SETS_CAPTURED: int = wp.constant(1)
"""Rays hit only splat sets that are not relit."""

SETS_RELIT: int = wp.constant(2)

TILE_PACKETS = wp.constant(int(TILE_BLOCKS) * int(TILE_BLOCKS))

load_candidate = aligned_load_of(Candidate)

prefetch_candidate = prefetch_of(Candidate)

prefetch_particle = prefetch_of(Particle)


@functools.cache
def tile_trace_kernel(lanes: int) -> Any:
    """Returns the kernel whose threads trace ``lanes`` rays each."""
    LANES = lanes
    THREADS = PACKET_RAYS // lanes  # of each square of rays
    STEP = BLEND_STEP_CUDA if lanes == 1 else BLEND_STEP
    options = {**PACKET_OPTIONS, "block_dim": PACKET_BOUNDS[0]}
    tools, tracing = packet_of(lanes), packet_tracing_of(lanes)
    RaysStorage, packet_rays, load_packet = tools.rays_storage, tools.packet_rays, tools.load_packet
    ends_of, largest, move_rays = tools.ends_of, tools.largest, tools.move_rays
    TracedStorage, traced_packet, buffer_hits = tracing.storage, tracing.traced_packet, tracing.buffer_hits

    @wp.kernel(module="unique", module_options=options, launch_bounds=PACKET_BOUNDS)
    def trace_tiles(
        start: int,
        settings: wp.array[TraceData],
        sets: int,
        lists: CandidateLists,
        scene: SceneBvh,
        rays: RayData,
        limits: wp.array[float],
        radiance_out: GaussianHits,
    ):
        """Blends the Gaussians on each camera ray up to the ray's limit."""
        item = start + wp.tid()
        number = item // THREADS
        tile = number // TILE_PACKETS
        within = number % TILE_PACKETS
        x = (tile % lists.tiles_x) * TILE_BLOCKS + within % TILE_BLOCKS
        y = (tile // lists.tiles_x) * TILE_BLOCKS + within // TILE_BLOCKS
        if x >= lists.blocks_x or y >= lists.blocks_y:
            return
        first = ((y * lists.blocks_x + x) * THREADS + item % THREADS) * LANES
        config = settings[0]
        for lane in range(LANES):
            radiance_out.depth[first + lane] = wp.inf
            store_pixel(radiance_out, first + lane, empty_pixel())
            begin_relit(radiance_out, first + lane)
        ends = ends_of(rays, limits, first)
        begin = lists.starts[tile]
        end = lists.starts[tile + 1]
        if largest(ends) < 0.0 or begin == end:
            return

        traced_storage = TracedStorage()
        traced = traced_packet(traced_storage)
        rays_storage = RaysStorage()
        packet = packet_rays(rays_storage)
        particle = Particle()
        candidate = Candidate()
        instance = SplatInstanceData()
        profiles = wp.array(ptr=wp.uint64(0), shape=(0,), dtype=HitProfiles)  # empty
        entered = int(-1)
        load_packet(packet, ends, rays, first)
        begin_rays(traced)
        again = bool(True)
        while again:
            begin_pass(traced, packet, config, scene)
            reach = largest(traced.cut_t)
            nearest = float(FAR)  # distance of the nearest hit in the lists
            k = int(begin)
            while k < end:
                index = lists.items[k]
                prefetch_candidate(lists.candidates, lists.items[wp.min(k + CANDIDATES_AHEAD, end - 1)])
                prefetch_particle(lists.particles, lists.items[wp.min(k + PARTICLES_AHEAD, end - 1)])
                load_candidate(lists.candidates, index, candidate)
                k += 1
                if k % STEP == 0 and nearest < candidate.floor and config.strategy != STRATEGY_HIT:
                    bound = candidate.floor
                    nearest = blend_final_hits(
                        traced, packet, bound, config, scene, rays, first, radiance_out, profiles
                    )
                    reach = largest(traced.cut_t)
                if candidate.floor > reach:
                    k = int(end)
                elif (
                    x >= int(candidate.blocks.x0)
                    and x < int(candidate.blocks.x1)
                    and y >= int(candidate.blocks.y0)
                    and y < int(candidate.blocks.y1)
                ):
                    if candidate.instance != entered:
                        entered = candidate.instance
                        instance = scene.instances[entered]
                        move_rays(packet, instance, rays, first)
                    if sets == SETS_ALL or (sets == SETS_RELIT) == (instance.relit != 0):
                        load_particle(lists.particles, index, particle)
                        first_t = buffer_hits(traced, packet, particle, instance, config, scene, rays, first)
                        if first_t < FAR:
                            nearest = lesser(nearest, first_t)
                            reach = largest(traced.cut_t)
            if nearest < FAR:
                blend_final_hits(traced, packet, FAR, config, scene, rays, first, radiance_out, profiles)
            again = config.strategy != STRATEGY_HIT and is_cut(traced, packet, scene)
        for lane in range(LANES):
            if packet.limit[lane] > 0.0:
                close_last_pass(traced.rays[lane], packet.t_max[lane], scene, rays, first + lane, radiance_out)

    return trace_tiles
