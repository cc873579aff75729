"""Gaussians along rays: a bundle of neighbouring rays walks the trees together.

One item is one packet of ``lanes`` consecutive rays: 16 on the CPU, where a loop over the lanes becomes vector
instructions, 1 on CUDA. A packet descends nearest child first and keeps, for each of its rays, the nearest hits sorted
by (t, index). Whatever lies before all nodes that still wait is final, and is blended at once. A ray whose list
overflows forgets its farthest hit, and starts again behind the last one blended: that is a pass. So the result is that
of sorting all hits.

The strategies differ in two places: a stochastic hit is drawn before it enters the list, which then holds one; and a
stochastic pass is drawn whenever k hits were blended.

The equations are in docs/method/ray_tracing.md.
"""

import functools
from typing import Any

import warp as wp

from lumisplat.constants import NODE_WIDTH, PASS_REWIND, TRAVERSE_STACK
from lumisplat.device.bvh.node_test import enter_children, larger, lesser
from lumisplat.device.bvh.ray_packet import PACKET_OPTIONS, packet_of
from lumisplat.device.gaussian.compositing import empty_pixel
from lumisplat.device.gaussian.particle import alpha_of_degree
from lumisplat.device.gaussian.projection import alpha_from_log
from lumisplat.device.gaussian.ray_compositing import blend_hit, end_pass, load_pixel, store_pixel
from lumisplat.device.math.random import draw_mixed, mix
from lumisplat.device.structs.bvh import FAR, AssetBvh, Node, Slabs, TraceData
from lumisplat.device.structs.rays import GaussianHits, Ray, RayData
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options(PACKET_OPTIONS)

SORTED = 0
HIT = 1
PASS = 2

STRATEGY_HIT = wp.constant(HIT)
STRATEGY_PASS = wp.constant(PASS)
WIDTH = wp.constant(NODE_WIDTH)
NO_INDEX = wp.constant(2**31 - 1)
REWIND = wp.constant(wp.float32(PASS_REWIND))

StackFloats = wp.types.vector(length=TRAVERSE_STACK, dtype=wp.float32)
StackInts = wp.types.vector(length=TRAVERSE_STACK, dtype=wp.int32)


@functools.cache
def gaussian_trace_kernel(lanes: int, hits: int) -> Any:
    """The kernel for packets of ``lanes`` rays that keep ``hits`` hits each."""
    LANES = lanes
    HITS = hits
    Floats, Ints, gather, slabs_of, meet_particle, _ = packet_of(lanes)
    HitFloats = wp.types.vector(length=lanes * hits, dtype=wp.float32)
    HitInts = wp.types.vector(length=lanes * hits, dtype=wp.int32)

    @wp.kernel(module="unique", module_options=PACKET_OPTIONS)
    def integrate_gaussians(
        start: int,
        settings: wp.array[TraceData],
        instances: wp.array[SplatInstanceData],
        assets: wp.array[AssetBvh],
        tlas_nodes: wp.array[Node],
        radius_max: float,
        rays: RayData,
        limits: wp.array[float],
        radiance_out: GaussianHits,
    ):
        """Longer than a kernel should be: its lists live on the stack, and Warp passes vectors by value."""
        first = (start + wp.tid()) * LANES
        view = settings[0]
        slots = int(HITS)
        if view.strategy == STRATEGY_HIT:
            slots = int(1)

        waiting = Floats(-FAR)  # ends of the rays that have not been followed yet
        live = int(0)
        for lane in range(LANES):
            radiance_out.depth[first + lane] = wp.inf
            store_pixel(radiance_out, first + lane, empty_pixel())
            if rays.is_active[first + lane] and limits[first + lane] > wp.max(rays.t_min[first + lane], 0.0):
                waiting[lane] = wp.min(limits[first + lane], FAR)
                live += 1
        while live > 0:
            whole = gather(rays, first, waiting, radius_max)
            t_min = Floats()
            limit = Floats()  # hits at or behind it do not count; negative: the ray is done, or there is none
            for lane in range(LANES):
                limit[lane] = whole[lane]
                t_min[lane] = rays.t_min[first + lane]
                if whole[lane] > 0.0:
                    waiting[lane] = -FAR
                    live -= 1

            taken = Ints()  # of the current stochastic pass
            last_t = Floats(-FAR)
            last_index = Ints(-1)
            # Hits up to here belong to earlier passes. Not the last one blended: rounding may deliver a hit late.
            start_t = Floats(-FAR)
            start_index = Ints(-1)

            again = int(1)
            while again != 0:
                again = int(0)
                # The lists: of each ray its hits from head to tail, side by side in their order.
                hit_t = HitFloats()
                hit_alpha = HitFloats()
                hit_index = HitInts()
                head = Ints()
                tail = Ints()
                next_t = Floats(FAR)  # of the nearest hit in the list
                cut_t = Floats()  # hits from (cut_t, cut_index) on are left to another pass
                cut_index = Ints(-1)
                begin = float(FAR)
                reach = float(-FAR)
                for lane in range(LANES):
                    head[lane] = lane * HITS
                    tail[lane] = lane * HITS
                    cut_t[lane] = limit[lane]
                    start_t[lane] = last_t[lane]
                    start_index[lane] = last_index[lane]
                    if limit[lane] > 0.0:
                        before = start_t[lane] - REWIND * wp.abs(start_t[lane])
                        begin = lesser(begin, larger(t_min[lane], wp.where(view.hull != 0, -FAR, before)))
                        reach = larger(reach, limit[lane])
                nearest = float(FAR)

                # The nodes that wait, nearest on top; below each, the distance before which all up to it are empty.
                entry = StackFloats()
                floor = StackFloats()
                link = StackInts()
                owner = StackInts()  # instance whose tree the node is of; -1: the tree of the instances
                owner[0] = -1
                top = int(1)
                current = int(-2)
                instance = SplatInstanceData()
                slabs = Slabs()
                ox = Floats()
                oy = Floats()
                oz = Floats()
                dx = Floats()
                dy = Floats()
                dz = Floats()
                while top > 0:
                    top -= 1
                    # No reach: all rays are done. Nodes around the origin are entered at -FAR too.
                    if reach > -FAR and entry[top] <= reach:
                        if owner[top] != current:
                            current = owner[top]
                            to_object = wp.identity(n=3, dtype=wp.float32)
                            offset = wp.vec3(0.0)
                            if current >= 0:
                                instance = instances[current]
                                to_object = instance.object_from_world
                                offset = instance.object_from_world_offset
                            for lane in range(LANES):
                                o = to_object * rays.origin[first + lane] + offset
                                d = to_object * rays.direction[first + lane]
                                ox[lane] = o[0]
                                oy[lane] = o[1]
                                oz[lane] = o[2]
                                dx[lane] = d[0]
                                dy[lane] = d[1]
                                dz[lane] = d[2]
                            slabs = slabs_of(limit, ox, oy, oz, dx, dy, dz)
                        node = Node()
                        if current < 0:
                            node = tlas_nodes[link[top]]
                        else:
                            node = assets[instance.asset].nodes[link[top]]
                        links = node.link
                        entries = enter_children(node, slabs, begin)
                        base = int(top)
                        for c in range(WIDTH):
                            if entries[c] <= reach:
                                if links[c] >= 0 or current < 0:
                                    # A node waits in its place among its siblings; an instance as its root.
                                    j = int(top)
                                    while j > base and entry[wp.max(j - 1, 0)] < entries[c]:
                                        entry[j] = entry[j - 1]
                                        link[j] = link[j - 1]
                                        owner[j] = owner[j - 1]
                                        j -= 1
                                    entry[j] = entries[c]
                                    link[j] = wp.max(links[c], 0)
                                    owner[j] = wp.where(links[c] < 0, ~links[c], current)
                                    top += 1
                                else:
                                    particle = assets[instance.asset].particles[~links[c]]
                                    index = instance.first + particle.index
                                    t, distance2 = meet_particle(
                                        particle, view.hull, ox, oy, oz, dx, dy, dz, t_min, whole
                                    )
                                    alpha = Floats()
                                    found = int(0)
                                    for lane in range(LANES):
                                        behind = wp.where(t[lane] > start_t[lane], 1, 0) | (
                                            wp.where(t[lane] == start_t[lane], 1, 0)
                                            & wp.where(index > start_index[lane], 1, 0)
                                        )
                                        ahead = wp.where(t[lane] < cut_t[lane], 1, 0) | (
                                            wp.where(t[lane] == cut_t[lane], 1, 0)
                                            & wp.where(index < cut_index[lane], 1, 0)
                                        )
                                        t[lane] = wp.where((behind & ahead) != 0, t[lane], FAR)
                                        found += behind & ahead
                                        alpha[lane] = alpha_from_log(particle.log_opacity - 0.5 * distance2[lane])
                                    if found > 0 and instance.kernel.degree != 2:
                                        for lane in range(LANES):
                                            alpha[lane] = alpha_of_degree(
                                                instance.kernel, particle.log_opacity, distance2[lane]
                                            )
                                    if found > 0 and view.strategy == STRATEGY_HIT:
                                        dimension = mix(wp.uint32(index))
                                        for lane in range(LANES):
                                            number = draw_mixed(rays.sample_key[first + lane], dimension)
                                            t[lane] = wp.where(
                                                number * view.acceptance_scale < alpha[lane], t[lane], FAR
                                            )
                                    if found > 0:
                                        for lane in range(LANES):
                                            if t[lane] < FAR:
                                                bottom = lane * HITS
                                                low = head[lane]
                                                end = tail[lane]
                                                keep = int(1)
                                                if end == bottom + slots and low > bottom:
                                                    for j in range(low, end):
                                                        hit_t[bottom + j - low] = hit_t[j]
                                                        hit_alpha[bottom + j - low] = hit_alpha[j]
                                                        hit_index[bottom + j - low] = hit_index[j]
                                                    end = bottom + end - low
                                                    low = bottom
                                                    head[lane] = low
                                                if end == bottom + slots:
                                                    # Full: the farthest has to wait for another pass.
                                                    cut_t[lane] = hit_t[end - 1]
                                                    cut_index[lane] = hit_index[end - 1]
                                                    if t[lane] < cut_t[lane] or (
                                                        t[lane] == cut_t[lane] and index < cut_index[lane]
                                                    ):
                                                        end -= 1
                                                    else:
                                                        cut_t[lane] = t[lane]
                                                        cut_index[lane] = index
                                                        keep = int(0)
                                                if keep != 0:
                                                    j = int(end)
                                                    while j > low and hit_t[wp.max(j - 1, 0)] > t[lane]:
                                                        hit_t[j] = hit_t[j - 1]
                                                        hit_alpha[j] = hit_alpha[j - 1]
                                                        hit_index[j] = hit_index[j - 1]
                                                        j -= 1
                                                    while (
                                                        j > low
                                                        and hit_t[wp.max(j - 1, 0)] == t[lane]
                                                        and hit_index[wp.max(j - 1, 0)] > index
                                                    ):
                                                        hit_t[j] = hit_t[j - 1]
                                                        hit_alpha[j] = hit_alpha[j - 1]
                                                        hit_index[j] = hit_index[j - 1]
                                                        j -= 1
                                                    hit_t[j] = t[lane]
                                                    hit_alpha[j] = alpha[lane]
                                                    hit_index[j] = index
                                                    end += 1
                                                tail[lane] = end
                                                next_t[lane] = hit_t[low]
                                                nearest = lesser(nearest, hit_t[low])
                                                if view.strategy == STRATEGY_HIT:
                                                    cut_t[lane] = hit_t[low]
                                                    cut_index[lane] = hit_index[low]
                                        reach = float(-FAR)
                                        for lane in range(LANES):
                                            reach = larger(reach, cut_t[lane])
                        below = float(FAR)
                        if base > 0:
                            below = floor[wp.max(base - 1, 0)]
                        for j in range(base, top):
                            floor[j] = lesser(entry[j], below)

                    # Hits before everything that waits are final.
                    bound = float(FAR)
                    if top > 0:
                        bound = floor[top - 1]
                    if view.strategy == STRATEGY_HIT and top > 0:
                        bound = -FAR
                    if nearest < bound:
                        nearest = float(FAR)
                        reach = float(-FAR)
                        for lane in range(LANES):
                            if next_t[lane] < bound:
                                ray = Ray()
                                ray.origin = rays.origin[first + lane]
                                ray.direction = rays.direction[first + lane]
                                ray.path_length = rays.path_length[first + lane]
                                pixel = load_pixel(radiance_out, first + lane)
                                low = head[lane]
                                end = tail[lane]
                                while low < end and hit_t[low] < bound:
                                    index = hit_index[low]
                                    opacity = hit_alpha[low]
                                    if view.strategy == STRATEGY_HIT:
                                        opacity = float(1.0)
                                    pixel = blend_hit(pixel, view, instances, assets, ray, index, opacity)
                                    if pixel.surface == index:
                                        radiance_out.depth[first + lane] = larger(hit_t[low], 0.0)
                                    if hit_t[low] > last_t[lane] or (
                                        hit_t[low] == last_t[lane] and index > last_index[lane]
                                    ):
                                        last_t[lane] = hit_t[low]
                                        last_index[lane] = index
                                    low += 1
                                    if view.strategy == STRATEGY_PASS:
                                        taken[lane] = taken[lane] + 1
                                        if taken[lane] == view.hits_per_pass:
                                            taken[lane] = 0
                                            pixel = end_pass(pixel, rays.sample_key[first + lane], index)
                                            if pixel.surface < 0:
                                                radiance_out.depth[first + lane] = wp.inf
                                            elif pixel.surface == index:
                                                radiance_out.depth[first + lane] = larger(hit_t[low - 1], 0.0)
                                    if pixel.transmittance <= view.transmittance_min:
                                        limit[lane] = -FAR
                                        low = end
                                        cut_t[lane] = -FAR
                                store_pixel(radiance_out, first + lane, pixel)
                                next_t[lane] = FAR
                                if low < end:
                                    next_t[lane] = hit_t[low]
                                else:
                                    low = lane * HITS
                                    tail[lane] = low
                                head[lane] = low
                            nearest = lesser(nearest, next_t[lane])
                            reach = larger(reach, cut_t[lane])
                        if reach < 0.0:
                            top = int(0)
                if view.strategy != STRATEGY_HIT:
                    for lane in range(LANES):
                        if cut_t[lane] < limit[lane]:
                            again = int(1)

            for lane in range(LANES):
                if taken[lane] > 0 and limit[lane] > 0.0:
                    # The last pass of the ray, with fewer hits.
                    pixel = load_pixel(radiance_out, first + lane)
                    pixel = end_pass(pixel, rays.sample_key[first + lane], last_index[lane])
                    store_pixel(radiance_out, first + lane, pixel)
                    if pixel.surface < 0:
                        radiance_out.depth[first + lane] = wp.inf
                    elif pixel.surface == last_index[lane]:
                        radiance_out.depth[first + lane] = larger(last_t[lane], 0.0)

    return integrate_gaussians
