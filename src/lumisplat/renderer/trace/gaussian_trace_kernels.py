"""Kernels that trace rays through Gaussians; packets of neighbouring rays traverse the BVHs together.

One thread traces ``lanes`` consecutive rays: 16 on the CPU, where a loop over them compiles to vector instructions, and
1 on CUDA, where the threads of a warp run in step. Rays with similar origins and directions form a packet. The packet
visits the nearest child first, and each ray keeps its nearest hits sorted by (t, index). Hits nearer than all nodes on
the stack are final and are blended at once. A ray whose list overflows drops its farthest hit, and later starts another
traversal (pass) behind the last blended hit. The result therefore equals sorting all hits.

The equations are in docs/method/ray_tracing.md.
"""

import functools
from typing import Any

import warp as wp

from lumisplat.constants import TRAVERSE_STACK
from lumisplat.device.bvh.nodes import lesser
from lumisplat.device.bvh.packet import (
    NEAR_FIRST,
    PACKET_BOUNDS,
    PACKET_OPTIONS,
    SPREAD_MAX,
    group_of,
    largest_of,
    node_stack_of,
    packet_of,
    push_root,
)
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
from lumisplat.device.splat.blending import begin_relit, empty_pixel
from lumisplat.device.structs.bvh import (
    FAR,
    STRATEGY_HIT,
    WORLD,
    ChildLinks,
    PacketTree,
    Particle,
    SceneBvh,
    TraceData,
)
from lumisplat.device.structs.rays import GaussianHits, HitProfiles, RayData

wp.set_module_options(PACKET_OPTIONS)


@functools.cache
def gaussian_trace_kernel(lanes: int, entries: int = TRAVERSE_STACK) -> Any:
    """Returns the kernel whose threads trace ``lanes`` rays each, with a traversal stack of ``entries`` nodes."""
    LANES = lanes
    options = {**PACKET_OPTIONS, "block_dim": PACKET_BOUNDS[0]}
    stacks = node_stack_of(entries)
    NodeStackStorage, node_stack = stacks.storage, stacks.node_stack
    tools, tracing = packet_of(lanes), packet_tracing_of(lanes)
    RaysStorage, packet_rays, begin_packet = tools.rays_storage, tools.packet_rays, tools.begin_packet
    ends_of, largest = tools.ends_of, tools.largest
    enter_instance, visit_node = tools.enter_instance, tools.visit_node
    TracedStorage, traced_packet, buffer_hits = tracing.storage, tracing.traced_packet, tracing.buffer_hits

    @wp.kernel(module="unique", module_options=options, launch_bounds=PACKET_BOUNDS)
    def trace_gaussians(
        start: int,
        settings: wp.array[TraceData],
        scene: SceneBvh,
        rays: RayData,
        limits: wp.array[float],
        radiance_out: GaussianHits,
        profiles_out: wp.array[HitProfiles],
    ):
        """Blends the Gaussians on each ray up to the ray's limit.

        ``profiles_out`` is empty unless every single hit is to be written.
        """
        first = (start + wp.tid()) * LANES
        config = settings[0]
        for lane in range(LANES):
            radiance_out.depth[first + lane] = wp.inf
            store_pixel(radiance_out, first + lane, empty_pixel())
            begin_relit(radiance_out, first + lane)
        waiting = ends_of(rays, limits, first)
        if largest(waiting) < 0.0:
            return

        traced_storage = TracedStorage()
        traced = traced_packet(traced_storage)
        rays_storage = RaysStorage()
        packet = packet_rays(rays_storage)
        stack_storage = NodeStackStorage()
        stack = node_stack(stack_storage)
        leaves = ChildLinks()
        particle = Particle()
        tree = PacketTree()
        while largest(waiting) > 0.0:
            begin_packet(packet, waiting, rays, first, scene.packet_radius)
            packet.group = group_of(rays.origin[first], rays.direction[first], scene.packet_radius, SPREAD_MAX)
            begin_rays(traced)
            again = bool(True)
            while again:
                begin = begin_pass(traced, packet, config, scene)
                own_reach = largest(traced.cut_t)
                own_end = largest(packet.limit)
                reach = largest_of(packet.group, own_reach)
                end = largest_of(packet.group, own_end)
                nearest = float(FAR)  # distance of the nearest hit in the lists
                top = push_root(stack)
                enter_instance(tree, packet, WORLD, scene, rays, first)
                while top > 0:
                    top -= 1
                    if stack[top].entry <= reach:
                        number = stack[top].instance
                        if number != tree.number:
                            enter_instance(tree, packet, number, scene, rays, first)
                        hit_distance = scene.hit_distance
                        if number != WORLD:
                            hit_distance = tree.instance.hit_distance
                        leaf_count = visit_node(
                            stack, top, leaves, tree, scene, packet.group, begin, reach, NEAR_FIRST, hit_distance, end
                        )
                        for leaf in range(leaf_count):
                            load_particle(scene.assets[tree.instance.asset].particles, leaves[leaf], particle)
                            first_t = buffer_hits(traced, packet, particle, tree.instance, config, scene, rays, first)
                            if first_t < FAR:
                                nearest = lesser(nearest, first_t)
                                own_reach = largest(traced.cut_t)
                    # Hits nearer than all nodes on the stack are final; a stochastic hit only once the stack is empty.
                    bound = float(FAR)
                    if top > 0:
                        bound = wp.where(config.strategy == STRATEGY_HIT, -FAR, stack[top - 1].floor)
                    if nearest < bound:
                        nearest = blend_final_hits(
                            traced, packet, bound, config, scene, rays, first, radiance_out, profiles_out
                        )
                        own_reach = largest(traced.cut_t)
                        own_end = largest(packet.limit)
                    reach = largest_of(packet.group, own_reach)
                    end = largest_of(packet.group, own_end)
                    if end < 0.0:
                        top = int(0)
                again = config.strategy != STRATEGY_HIT and is_cut(traced, packet, scene)
            for lane in range(LANES):
                if packet.limit[lane] > 0.0:
                    close_last_pass(traced.rays[lane], packet.t_max[lane], scene, rays, first + lane, radiance_out)

    return trace_gaussians
