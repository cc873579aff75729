"""A packet of rays side by side: which rays are traced together, and how they traverse the trees.

Loops over the lanes become vector instructions, so types and functions are made for a number of lanes: ``PACKET_RAYS``
on the CPU; a CUDA thread has a single one.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from lumisplat.constants import COHERENT_SPREAD, FUSED_FLAGS
from lumisplat.device.bvh.footprint import footprint_of_ray, footprint_slope
from lumisplat.device.bvh.node_stack import push_children
from lumisplat.device.bvh.node_test import enter_children, larger, mean_entries, slabs_around
from lumisplat.device.bvh.ray_group import largest_of, largest_vector, least_vector
from lumisplat.device.math.aligned_memory import aligned_load_of
from lumisplat.device.structs.bvh import FAR, HIT_MEAN, WORLD, ChildLinks, Node, SceneBvh
from lumisplat.device.structs.declare import struct
from lumisplat.device.structs.packet import PacketPlace, PacketRays, Slabs, WaitingNode
from lumisplat.device.structs.rays import RayData

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

PACKET_OPTIONS = {
    "enable_backward": False,
    # Loops over lanes and children must stay loops for the vectoriser, and multiply-adds are to be fused.
    "max_unroll": 4,
    "cpu_compiler_flags": FUSED_FLAGS,
}
"""Of the modules that trace packets."""

SPREAD_MAX = wp.constant(wp.float32(COHERENT_SPREAD))

load_node = aligned_load_of(Node)


class RayPacket(NamedTuple):
    """Types and functions for a number of lanes."""

    floats: Any
    """Vector of a number a ray."""
    ints: Any
    vec3s: Any
    """Matrix of a 3-vector a ray, the rays being its columns."""
    rays_storage: Any
    """The type of a variable in which PacketRays lie."""
    packet_rays: Any
    ends_of: Any
    largest: Any
    take_coherent: Any
    begin_packet: Any
    slabs_of: Any
    enter_instance: Any
    visit_node: Any


@functools.cache
def packet_of(lanes: int) -> RayPacket:
    """What packets of up to ``lanes`` rays need."""
    LANES = lanes
    Floats = wp.types.vector(length=lanes, dtype=wp.float32)
    Ints = wp.types.vector(length=lanes, dtype=wp.int32)
    Vec3s = wp.types.matrix(shape=(3, lanes), dtype=wp.float32)

    @struct
    class RaysStorage:
        """The variable in which PacketRays lie."""

        origin: Vec3s
        direction: Vec3s
        t_min: Floats
        limit: Floats
        path_length: Floats
        spread: Floats
        footprint: Floats
        t_max: Floats

    @wp.func
    def packet_rays(storage: wp.ref[RaysStorage]) -> PacketRays:
        """The rays that lie in a variable."""
        packet = PacketRays()
        packet.origin = wp.array(ptr=wp.address_of(storage.origin), shape=(3, LANES), dtype=float)
        packet.direction = wp.array(ptr=wp.address_of(storage.direction), shape=(3, LANES), dtype=float)
        packet.t_min = wp.array(ptr=wp.address_of(storage.t_min), shape=(LANES,), dtype=float)
        packet.limit = wp.array(ptr=wp.address_of(storage.limit), shape=(LANES,), dtype=float)
        packet.path_length = wp.array(ptr=wp.address_of(storage.path_length), shape=(LANES,), dtype=float)
        packet.spread = wp.array(ptr=wp.address_of(storage.spread), shape=(LANES,), dtype=float)
        packet.footprint = wp.array(ptr=wp.address_of(storage.footprint), shape=(LANES,), dtype=float)
        packet.t_max = wp.array(ptr=wp.address_of(storage.t_max), shape=(LANES,), dtype=float)
        return packet

    @wp.func
    def ends_of(rays: RayData, limits: wp.array[float], first: int) -> Floats:
        """Where rays end, at most FAR; -FAR for those that are not active or end before they begin."""
        ends = Floats(-FAR)
        for lane in range(LANES):
            if rays.is_active[first + lane] and limits[first + lane] > 0.0:
                ends[lane] = wp.min(limits[first + lane], FAR)
        return ends

    @wp.func
    def largest(numbers: Any) -> float:
        """The largest of a number a ray, in a vector or an array; at least -FAR."""
        most = float(-FAR)
        for lane in range(LANES):
            most = larger(most, numbers[lane])
        return most

    @wp.func
    def take_coherent(rays: RayData, first: int, waiting: wp.ref[Floats], radius_max: float) -> Floats:
        """Takes the first of the rays that wait, and those that start and point nearly as it does.

        Args:
            rays: The rays.
            first: The ray of lane 0.
            waiting: Positive for rays that wait; becomes -FAR for those that are taken.
            radius_max: How far apart rays may start.

        Returns:
            The numbers of the rays that are taken, and -FAR for the others.
        """
        numbers = waiting
        origin = wp.vec3()
        along = wp.vec3()
        found = int(0)
        taken = Floats(-FAR)
        for lane in range(LANES):
            if numbers[lane] > 0.0:
                if found == 0:
                    origin = rays.origin[first + lane]
                    along = rays.direction[first + lane]
                apart = wp.length(rays.origin[first + lane] - origin)
                bend = wp.length(rays.direction[first + lane] - along)
                if found == 0 or (apart <= radius_max and bend <= SPREAD_MAX):
                    taken[lane] = numbers[lane]
                    numbers[lane] = -FAR
                found = int(1)
        waiting = numbers
        return taken

    @wp.func
    def begin_packet(packet: PacketRays, waiting: wp.ref[Floats], rays: RayData, first: int, radius_max: float):
        """Takes rays that wait, as ``take_coherent`` does; their numbers are where they end."""
        ends = take_coherent(rays, first, waiting, radius_max)
        for lane in range(LANES):
            packet.t_min[lane] = rays.t_min[first + lane]
            packet.t_max[lane] = ends[lane]
            packet.limit[lane] = ends[lane]
            packet.path_length[lane] = rays.path_length[first + lane]
            packet.spread[lane] = rays.spread[first + lane]

    @wp.func
    def slabs_of(packet: PacketRays) -> Slabs:
        """What bounds the rays whose limit is positive: a box around their origins, least and largest slopes.

        Those of the other threads of the group are bounded, too.

        Footprints bound where the widened Gaussians of a box may be hit (docs/method/ray_tracing.md#footprints).
        """
        low = wp.vec3(FAR)
        high = wp.vec3(-FAR)
        slow = wp.vec3(FAR)
        fast = wp.vec3(-FAR)
        slowest = wp.vec3(FAR)
        fastest = wp.vec3(-FAR)
        length2 = float(-FAR)
        for lane in range(LANES):
            if packet.limit[lane] > 0.0:
                o = wp.vec3(packet.origin[0, lane], packet.origin[1, lane], packet.origin[2, lane])
                d = wp.vec3(packet.direction[0, lane], packet.direction[1, lane], packet.direction[2, lane])
                length2 = wp.length_sq(d)
                slope = wp.vec3(footprint_slope(packet.footprint[lane], wp.sqrt(length2)))
                low = wp.min(low, o - packet.path_length[lane] * slope)
                high = wp.max(high, o + packet.path_length[lane] * slope)
                slow = wp.min(slow, d - slope)
                fast = wp.max(fast, d + slope)
                slowest = wp.min(slowest, d)
                fastest = wp.max(fastest, d)
        group = packet.group
        slabs = slabs_around(
            least_vector(group, low),
            largest_vector(group, high),
            least_vector(group, slow),
            largest_vector(group, fast),
        )
        length2 = largest_of(group, length2)
        slabs.slow = least_vector(group, slowest) / length2
        slabs.fast = largest_vector(group, fastest) / length2
        return slabs

    @wp.func
    def enter_instance(
        place: wp.ref[PacketPlace],
        packet: PacketRays,
        number: int,
        scene: SceneBvh,
        rays: RayData,
        first: int,
    ):
        """Goes on to another tree.

        Args:
            place: Becomes that tree.
            packet: Receives the origins and directions in its space.
            number: The instance whose tree it is, or WORLD.
            scene: The trees.
            rays: The rays in the world.
            first: The ray of lane 0.
        """
        place.number = number
        object_from_world = wp.identity(n=3, dtype=wp.float32)
        offset = wp.vec3(0.0)
        footprint = scene.footprint
        scale = float(1.0)
        if number != WORLD:
            place.instance = scene.instances[number]
            object_from_world = place.instance.object_from_world
            offset = place.instance.object_from_world_offset
            footprint = place.instance.footprint
            scale = place.instance.scale
        for lane in range(LANES):
            packet.footprint[lane] = footprint_of_ray(footprint, packet.spread[lane], scale)
            o = object_from_world * rays.origin[first + lane] + offset
            d = object_from_world * rays.direction[first + lane]
            for k in range(3):
                packet.origin[k, lane] = o[k]
                packet.direction[k, lane] = d[k]
        place.slabs = slabs_of(packet)

    @wp.func
    def visit_node(
        stack: wp.array[WaitingNode],
        top: wp.ref[int],
        leaves: wp.ref[ChildLinks],
        place: wp.ref[PacketPlace],
        scene: SceneBvh,
        begin: float,
        reach: float,
        order: float,
        hit_distance: int,
        end: float,
    ) -> int:
        """Pushes the children of the node just above the top of the stack, as ``push_children``.

        Args:
            stack: The stack, from which the node was popped.
            top: Its height.
            leaves: Receives the Gaussians among the children.
            place: The tree that the node is of.
            scene: The trees.
            begin: Children that the packet leaves nearer are left out.
            reach: Children that it enters farther away are left out.
            order: NEAR_FIRST or FAR_FIRST.
            hit_distance: HIT_MEAN, or another one.
            end: With HIT_MEAN, where the last ray of the packet ends; ``reach`` is then a distance of means.

        Returns:
            The number of leaves.
        """
        link = stack[top].link
        nodes = scene.tlas_nodes
        if place.number != WORLD:
            nodes = scene.assets[place.instance.asset].nodes
        node = Node()
        load_node(nodes, link, node)
        is_by_mean = hit_distance == HIT_MEAN
        entries = enter_children(node, place.slabs, wp.where(is_by_mean, 0.0, larger(begin, 0.0)))
        if is_by_mean:
            entries = mean_entries(node, place.slabs, entries, begin, end)
        return push_children(stack, top, leaves, node, place.number, entries, reach, order)

    return RayPacket(
        *(Floats, Ints, Vec3s, RaysStorage, packet_rays),
        *(ends_of, largest, take_coherent, begin_packet, slabs_of, enter_instance, visit_node),
    )
