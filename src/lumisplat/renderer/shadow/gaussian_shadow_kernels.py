"""What of a light comes through Gaussians.

One item is one packet of ``lanes`` consecutive rays, as in ``trace_kernels``. Shares of light multiply, so nothing has
to be in order, and one walk through the trees is enough. It goes far from the points first: what the light shines on
first blocks it from all that is behind, while around the points themselves there is much that hardly does. Where only
the first hits count, it goes near first, and a list keeps the nearest.

The equations are in docs/method/shadows.md.
"""

import functools
from typing import Any

import warp as wp

from lumisplat.constants import NODE_WIDTH, TRAVERSE_STACK
from lumisplat.device.bvh.node_test import enter_children, larger, lesser
from lumisplat.device.bvh.ray_packet import PACKET_OPTIONS, packet_of
from lumisplat.device.gaussian.compositing import instance_of
from lumisplat.device.gaussian.particle import alpha_of_degree
from lumisplat.device.gaussian.projection import alpha_from_log
from lumisplat.device.light.shadow import shadow_key, shadow_of, tint_of
from lumisplat.device.math.random import draw_stratified
from lumisplat.device.structs.bvh import FAR, NO_CHILD, AssetBvh, Node, ShadowData, Slabs
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options(PACKET_OPTIONS)

WIDTH = wp.constant(NODE_WIDTH)

StackFloats = wp.types.vector(length=TRAVERSE_STACK, dtype=wp.float32)
StackInts = wp.types.vector(length=TRAVERSE_STACK, dtype=wp.int32)
Picks = wp.types.vector(length=NODE_WIDTH, dtype=wp.int32)


@functools.cache
def shadow_kernel(lanes: int, hits: int) -> Any:
    """The kernel for packets of ``lanes`` rays, of whose hits the nearest ``hits`` count; 0: all."""
    LANES = lanes
    HITS = max(hits, 1)
    FIRST = hits > 0
    ORDER = 1.0 if hits > 0 else -1.0  # of the distances at which nodes are entered
    Floats, Ints, gather, slabs_of, meet_particle, pass_particle = packet_of(lanes)
    HitFloats = wp.types.vector(length=LANES * HITS, dtype=wp.float32)
    HitInts = wp.types.vector(length=LANES * HITS, dtype=wp.int32)

    @wp.kernel(module="unique", module_options=PACKET_OPTIONS)
    def shade_by_gaussians(
        start: int,
        settings: wp.array[ShadowData],
        instances: wp.array[SplatInstanceData],
        assets: wp.array[AssetBvh],
        tlas_nodes: wp.array[Node],
        radius_max: float,
        rays: RayData,
        limits: wp.array[float],
        skips: wp.array[wp.bool],
        light_inout: wp.array[wp.vec3],
    ):
        """Multiplies the light of each ray with what the Gaussians up to its limit let through."""
        first = (start + wp.tid()) * LANES
        view = settings[0]
        least = wp.max(view.transmittance_min, view.threshold)
        key = shadow_key(view)
        tints = view.color_strength > 0.0 and view.stochastic == 0

        waiting = Floats(-FAR)  # limits of the rays that have not been followed yet
        live = int(0)
        for lane in range(LANES):
            if rays.is_active[first + lane] and limits[first + lane] > wp.max(rays.t_min[first + lane], 0.0):
                waiting[lane] = wp.min(limits[first + lane], FAR)
                live += 1
        while live > 0:
            limit = gather(rays, first, waiting, radius_max)  # negative: there is no ray
            t_min = Floats()
            left = Floats()  # transmittances of the rays that there are
            begin = float(FAR)
            reach = float(-FAR)
            for lane in range(LANES):
                t_min[lane] = rays.t_min[first + lane]
                if limit[lane] > 0.0:
                    waiting[lane] = -FAR
                    live -= 1
                    begin = lesser(begin, t_min[lane])
                    reach = larger(reach, limit[lane])
                    left[lane] = 1.0
            # Sums of linear colours, weighted by alpha.
            red = Floats()
            green = Floats()
            blue = Floats()
            # The nearest hits, in their order; those from (cut_t, cut_index) on do not count.
            hit_t = HitFloats()
            hit_alpha = HitFloats()
            hit_index = HitInts()
            held = Ints()
            cut_t = Floats(FAR)
            cut_index = Ints(-1)

            # The nodes that wait.
            ranks = StackFloats()
            link = StackInts()
            owner = StackInts()  # instance whose tree the node is of; -1: the tree of the instances
            owner[0] = -1
            top = int(1)
            current = int(-2)
            instance = SplatInstanceData()
            slabs = Slabs()
            end = Floats()
            ox = Floats()
            oy = Floats()
            oz = Floats()
            dx = Floats()
            dy = Floats()
            dz = Floats()
            while top > 0:
                top -= 1
                if FIRST and ranks[top] > reach:
                    continue
                if owner[top] != current:
                    current = owner[top]
                    to_object = wp.identity(n=3, dtype=wp.float32)
                    offset = wp.vec3(0.0)
                    blind = int(0)
                    if current >= 0:
                        instance = instances[current]
                        to_object = instance.object_from_world
                        offset = instance.object_from_world_offset
                        blind = instance.shadow_only
                    for lane in range(LANES):
                        o = to_object * rays.origin[first + lane] + offset
                        d = to_object * rays.direction[first + lane]
                        ox[lane] = o[0]
                        oy[lane] = o[1]
                        oz[lane] = o[2]
                        dx[lane] = d[0]
                        dy[lane] = d[1]
                        dz[lane] = d[2]
                        end[lane] = limit[lane]
                        if blind != 0 and skips[first + lane]:
                            end[lane] = -FAR
                    slabs = slabs_of(limit, ox, oy, oz, dx, dy, dz)
                node = Node()
                if current < 0:
                    node = tlas_nodes[link[top]]
                else:
                    node = assets[instance.asset].nodes[link[top]]
                links = node.link
                entries = enter_children(node, slabs, begin)
                pick = Picks()
                picks = int(0)
                base = int(top)
                for c in range(WIDTH):
                    # Rays without a direction enter all boxes, also those of no child.
                    if entries[c] <= reach and links[c] != NO_CHILD:
                        if links[c] >= 0 or current < 0:
                            # A node waits in its place among its siblings; an instance as its root.
                            rank = ORDER * entries[c]
                            j = int(top)
                            while j > base and ranks[wp.max(j - 1, 0)] < rank:
                                ranks[j] = ranks[j - 1]
                                link[j] = link[j - 1]
                                owner[j] = owner[j - 1]
                                j -= 1
                            ranks[j] = rank
                            link[j] = wp.max(links[c], 0)
                            owner[j] = wp.where(links[c] < 0, ~links[c], current)
                            top += 1
                        else:
                            pick[picks] = ~links[c]
                            picks += 1
                changed = int(0)
                for p in range(picks):
                    particle = assets[instance.asset].particles[pick[p]]
                    t = Floats(FAR)
                    distance2 = Floats()
                    along2 = Floats(1.0)
                    met = Ints()
                    found = int(0)
                    if FIRST:
                        t, distance2 = meet_particle(particle, view.hull, ox, oy, oz, dx, dy, dz, t_min, end)
                        for lane in range(LANES):
                            met[lane] = wp.where(t[lane] < FAR, 1, 0)
                    else:
                        met, distance2, along2 = pass_particle(particle, ox, oy, oz, dx, dy, dz, t_min, end)
                    for lane in range(LANES):
                        found = found | met[lane]
                    if found != 0:
                        changed = int(1)
                        alpha = Floats()
                        for lane in range(LANES):
                            distance2[lane] = distance2[lane] / along2[lane]
                            alpha[lane] = alpha_from_log(particle.log_opacity - 0.5 * distance2[lane])
                        if instance.kernel.degree != 2:
                            for lane in range(LANES):
                                alpha[lane] = alpha_of_degree(instance.kernel, particle.log_opacity, distance2[lane])
                        if FIRST:
                            index = instance.first + particle.index
                            reach = float(-FAR)
                            for lane in range(LANES):
                                if t[lane] < cut_t[lane] or (t[lane] == cut_t[lane] and index < cut_index[lane]):
                                    bottom = lane * HITS
                                    j = wp.min(held[lane], HITS - 1) + bottom
                                    while j > bottom and (
                                        hit_t[wp.max(j - 1, 0)] > t[lane]
                                        or (hit_t[wp.max(j - 1, 0)] == t[lane] and hit_index[wp.max(j - 1, 0)] > index)
                                    ):
                                        hit_t[j] = hit_t[j - 1]
                                        hit_alpha[j] = hit_alpha[j - 1]
                                        hit_index[j] = hit_index[j - 1]
                                        j -= 1
                                    hit_t[j] = t[lane]
                                    hit_alpha[j] = alpha[lane]
                                    hit_index[j] = index
                                    held[lane] = wp.min(held[lane] + 1, HITS)
                                    if held[lane] == HITS:
                                        cut_t[lane] = hit_t[bottom + HITS - 1]
                                        cut_index[lane] = hit_index[bottom + HITS - 1]
                                reach = larger(reach, lesser(cut_t[lane], limit[lane]))
                        else:
                            if view.stochastic != 0:
                                number = draw_stratified(key, view.sample, instance.first + particle.index)
                                for lane in range(LANES):
                                    alpha[lane] = wp.where(number < alpha[lane], 1.0, 0.0)
                            for lane in range(LANES):
                                alpha[lane] = wp.where(met[lane] != 0, alpha[lane], 0.0)
                                left[lane] = left[lane] * (1.0 - alpha[lane])
                            if tints:
                                color = tint_of(assets[instance.asset].gaussians, particle.index)
                                for lane in range(LANES):
                                    red[lane] = red[lane] + alpha[lane] * color[0]
                                    green[lane] = green[lane] + alpha[lane] * color[1]
                                    blue[lane] = blue[lane] + alpha[lane] * color[2]
                if changed != 0:
                    most = float(0.0)
                    for lane in range(LANES):
                        most = larger(most, left[lane])
                    if most <= least:
                        top = int(0)
            for lane in range(LANES):
                if limit[lane] > 0.0:
                    transmittance = left[lane]
                    tint = wp.vec3(red[lane], green[lane], blue[lane])
                    for j in range(lane * HITS, lane * HITS + held[lane]):
                        transmittance = transmittance * (1.0 - hit_alpha[j])
                        if tints:
                            index = hit_index[j]
                            placed = instances[instance_of(instances, index)]
                            tint += hit_alpha[j] * tint_of(assets[placed.asset].gaussians, index - placed.first)
                    shade = shadow_of(view, transmittance, tint)
                    light_inout[first + lane] = wp.cw_mul(light_inout[first + lane], shade)

    return shade_by_gaussians
