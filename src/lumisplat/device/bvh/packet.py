"""Packets: rays side by side that traverse the trees together, the nodes that wait for them, and the hits they keep.

Loops over the lanes become vector instructions, so types and functions are made for a number of lanes: ``PACKET_RAYS``
on the CPU; a CUDA thread has a single one.
"""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import warp as wp

from lumisplat.constants import FUSED_FLAGS, NODE_WIDTH
from lumisplat.device.bvh.nodes import (
    enter_children,
    footprint_of_ray,
    footprint_slope,
    larger,
    lesser,
    mean_entries,
    slabs_around,
)
from lumisplat.device.math.memory import aligned_load_of, storage_of
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import (
    FAR,
    HIT_MEAN,
    NO_CHILD,
    WORLD,
    ChildLinks,
    Children,
    Hit,
    HitList,
    Node,
    PacketRays,
    PacketTree,
    SceneBvh,
    Slabs,
    WaitingNode,
)
from lumisplat.device.structs.rays import RayData

COHERENT_SPREAD = 0.15
"""Rays of a packet are not traced with its first one if their directions differ from that one's by more than this."""

# --- The nearest hits of a ray, sorted as they are blended: by distance, then by index ---


@wp.func
def is_before(t: float, index: int, other_t: float, other_index: int) -> bool:
    """Whether a hit is nearer than another one; of two at the same distance, that of the lower index is."""
    return t < other_t or (t == other_t and index < other_index)


@wp.func
def empty_list(begin: int) -> HitList:
    """A list without hits, whose first slot is ``begin``."""
    hit_list = HitList()
    hit_list.begin = begin
    hit_list.head = begin
    hit_list.tail = begin
    return hit_list


@wp.func
def buffer_hit(hits: wp.array[Hit], hit_list: wp.ref[HitList], slots: int, hit: Hit) -> Hit:
    """Adds a hit to a list; if that is full, the farthest hit is dropped.

    ``slots``: how many hits the list may hold.

    Returns:
        The hit that was dropped; its distance is FAR if none was.
    """
    if hit_list.tail == hit_list.begin + slots:
        move_to_begin(hits, hit_list)
    dropped = Hit()
    dropped.t = FAR
    if hit_list.tail == hit_list.begin + slots:
        dropped = hits[hit_list.tail - 1]
        if not is_before(hit.t, hit.index, dropped.t, dropped.index):
            return hit
        hit_list.tail -= 1
    insert_hit(hits, hit_list, hit)
    return dropped


@wp.func
def move_to_begin(hits: wp.array[Hit], hit_list: wp.ref[HitList]):
    """Moves the hits of a list to its first slots."""
    shift = hit_list.head - hit_list.begin
    if shift > 0:
        for j in range(hit_list.head, hit_list.tail):
            hits[j - shift] = hits[j]
        hit_list.head -= shift
        hit_list.tail -= shift


@wp.func
def insert_hit(hits: wp.array[Hit], hit_list: wp.ref[HitList], hit: Hit):
    """Puts a hit in its place in a list that has a free slot."""
    head = hit_list.head
    j = int(hit_list.tail)
    while j > head and is_before(hit.t, hit.index, hits[j - 1].t, hits[j - 1].index):
        hits[j] = hits[j - 1]
        j -= 1
    hits[j] = hit
    hit_list.tail += 1


# --- Threads of a CUDA warp that traverse the trees in step, as the lanes of a packet do on a CPU ---
#
# A group is a mask of the warp's lanes, of rays that start and point alike. Whatever its threads decide together
# follows from numbers that they have agreed on here, so that all of them go the same way. A thread alone is the group
# 0; on CPUs all are.

GROUP_MIN = 8
"""Fewer rays than these go alone: what they would visit together is more than what they share."""


def _on_cuda(code: str, otherwise: str) -> str:
    """A body for CUDA, and a statement for CPUs."""
    return f"#if defined(__CUDA_ARCH__)\n{code}\n#else\n{otherwise}\n#endif\n"


_GROUP = """
const unsigned all = __activemask(), self = 1u << (threadIdx.x & 31);
unsigned waiting = all, group = 0;
while (waiting) {
    const int leader = __ffs(waiting) - 1;
    float apart = 0.0f, bend = 0.0f;
    for (int k = 0; k < 3; ++k) {
        const float from_origin = origin[k] - __shfl_sync(all, origin[k], leader);
        const float from_direction = direction[k] - __shfl_sync(all, direction[k], leader);
        apart += from_origin * from_origin;
        bend += from_direction * from_direction;
    }
    const bool is_alike = apart <= radius * radius && bend <= spread * spread;
    const unsigned taken = waiting & (__ballot_sync(all, is_alike) | 1u << leader);
    if (taken & self) group = taken;
    waiting &= ~taken;
}
return __popc(group) < GROUP_MIN ? 0 : static_cast<int>(group);
"""

# Floats in the order of integers: the hardware finds the largest of these in one instruction, from sm_80 on.
_LARGEST = """
if (group == 0) return number;
#if __CUDA_ARCH__ >= 800
const int bits = __float_as_int(number);
const int most = __reduce_max_sync(static_cast<unsigned>(group), bits < 0 ? bits ^ 0x7fffffff : bits);
return __int_as_float(most < 0 ? most ^ 0x7fffffff : most);
#else
float most = number;
for (unsigned rest = static_cast<unsigned>(group); rest; rest &= rest - 1)
    most = fmaxf(most, __shfl_sync(static_cast<unsigned>(group), number, __ffs(rest) - 1));
return most;
#endif
"""


@wp.func_native(_on_cuda(_GROUP.replace("GROUP_MIN", str(GROUP_MIN)), "return 0;"))
def group_of(origin: wp.vec3, direction: wp.vec3, radius: float, spread: float) -> int:
    """The group of a thread's ray: those of its warp of which a first one differs at most by these.

    All threads of the warp that have a ray call it together.
    """
    ...


@wp.func_native(_on_cuda(_LARGEST, "return number;"))
def largest_of(group: int, number: float) -> float:
    """The largest of the numbers of a group's threads, which all call it."""
    ...


@wp.func
def least_of(group: int, number: float) -> float:
    """The least of them."""
    return -largest_of(group, -number)


@wp.func
def largest_vector(group: int, numbers: wp.vec3) -> wp.vec3:
    """The largest of them, component by component."""
    return wp.vec3(largest_of(group, numbers[0]), largest_of(group, numbers[1]), largest_of(group, numbers[2]))


@wp.func
def least_vector(group: int, numbers: wp.vec3) -> wp.vec3:
    """The least of them, component by component."""
    return -largest_vector(group, -numbers)


# --- The stack of nodes that a packet still has to visit, the next one on top ---

WIDTH = wp.constant(NODE_WIDTH)

NEAR_FIRST = wp.constant(wp.float32(1.0))
"""Order of siblings: the one that is entered nearest is visited first."""

FAR_FIRST = wp.constant(wp.float32(-1.0))
"""It is visited last."""


@dataclass(frozen=True, slots=True)
class NodeStack:
    """What stacks of a size need."""

    storage: Any
    """The type of a variable in which the nodes lie."""
    node_stack: Any


@functools.cache
def node_stack_of(entries: int) -> NodeStack:
    """What stacks of so many entries need."""
    ENTRIES = entries
    NodeStackStorage = storage_of(WaitingNode, entries)

    @wp.func
    def node_stack(storage: wp.ref[NodeStackStorage]) -> wp.array[WaitingNode]:
        """The stack whose nodes lie in a variable."""
        return wp.array(ptr=wp.address_of(storage), shape=(ENTRIES,), dtype=WaitingNode)

    return NodeStack(NodeStackStorage, node_stack)


@wp.func
def push_root(stack: wp.array[WaitingNode]) -> int:
    """Makes the root of the tree over the instances all that waits; returns the height of the stack, 1."""
    root = WaitingNode()
    root.instance = WORLD
    stack[0] = root
    return 1


@wp.func
def push_children(
    stack: wp.array[WaitingNode],
    top: wp.ref[int],
    leaves: wp.ref[ChildLinks],
    node: Node,
    instance: int,
    entries: Children,
    reach: float,
    order: float,
) -> int:
    """Pushes the children of a node that are nodes, and collects those that are Gaussians.

    ``leaves`` receives the places of the Gaussians among the particles of the asset. Children whose entries lie beyond
    ``reach`` are left out; ``order`` is NEAR_FIRST or FAR_FIRST.

    Returns:
        The number of leaves.
    """
    links = node.link
    base = int(top)
    leaf_count = int(0)
    for c in range(WIDTH):
        # Rays without a direction enter all boxes, also those of no child.
        if entries[c] <= reach and links[c] != NO_CHILD:
            if links[c] >= 0 or instance == WORLD:
                child = WaitingNode()
                child.entry = entries[c]
                # An instance waits as the root of its tree.
                child.link = wp.max(links[c], 0)
                child.instance = wp.where(links[c] < 0, ~links[c], instance)
                insert_node(stack, base, top, child, order)
                top += 1
            else:
                leaves[leaf_count] = ~links[c]
                leaf_count += 1
    if order == NEAR_FIRST:
        set_floors(stack, base, top)
    return leaf_count


@wp.func
def insert_node(stack: wp.array[WaitingNode], base: int, top: int, node: WaitingNode, order: float):
    """Puts a node in its place among its siblings, which lie from ``base`` up to ``top``."""
    j = int(top)
    while j > base and order * stack[j - 1].entry < order * node.entry:
        stack[j] = stack[j - 1]
        j -= 1
    stack[j] = node


@wp.func
def set_floors(stack: wp.array[WaitingNode], base: int, top: int):
    """Sets the floors of siblings, which lie from ``base`` up to ``top``."""
    below = float(FAR)
    if base > 0:
        below = stack[base - 1].floor
    for j in range(base, top):
        stack[j].floor = lesser(stack[j].entry, below)


# --- Packets: which rays are traced together, and how they traverse the trees ---

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

        ``waiting`` is positive for rays that wait, and becomes -FAR for those that are taken; ``radius_max``: how far
        apart rays may start.

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
        tree: wp.ref[PacketTree],
        packet: PacketRays,
        number: int,
        scene: SceneBvh,
        rays: RayData,
        first: int,
    ):
        """Goes on to another tree.

        ``place`` becomes the tree of instance ``number``, or of WORLD, and ``packet`` receives the origins and
        directions in its space.
        """
        tree.number = number
        object_from_world = wp.identity(n=3, dtype=wp.float32)
        offset = wp.vec3(0.0)
        footprint = scene.footprint
        scale = float(1.0)
        if number != WORLD:
            tree.instance = scene.instances[number]
            object_from_world = tree.instance.object_from_world
            offset = tree.instance.object_from_world_offset
            footprint = tree.instance.footprint
            scale = tree.instance.scale
        for lane in range(LANES):
            packet.footprint[lane] = footprint_of_ray(footprint, packet.spread[lane], scale)
            o = object_from_world * rays.origin[first + lane] + offset
            d = object_from_world * rays.direction[first + lane]
            for k in range(3):
                packet.origin[k, lane] = o[k]
                packet.direction[k, lane] = d[k]
        tree.slabs = slabs_of(packet)

    @wp.func
    def visit_node(
        stack: wp.array[WaitingNode],
        top: wp.ref[int],
        leaves: wp.ref[ChildLinks],
        tree: wp.ref[PacketTree],
        scene: SceneBvh,
        begin: float,
        reach: float,
        order: float,
        hit_distance: int,
        end: float,
    ) -> int:
        """Pushes the children of the node just above the top of the stack, as ``push_children``.

        Children that the packet leaves before ``begin``, or enters beyond ``reach``, are left out. With HIT_MEAN,
        ``end`` is where the last ray of the packet ends, and ``reach`` a distance of means.

        Returns:
            The number of leaves.
        """
        link = stack[top].link
        nodes = scene.tlas_nodes
        if tree.number != WORLD:
            nodes = scene.assets[tree.instance.asset].nodes
        node = Node()
        load_node(nodes, link, node)
        is_by_mean = hit_distance == HIT_MEAN
        entries = enter_children(node, tree.slabs, wp.where(is_by_mean, 0.0, larger(begin, 0.0)))
        if is_by_mean:
            entries = mean_entries(node, tree.slabs, entries, begin, end)
        return push_children(stack, top, leaves, node, tree.number, entries, reach, order)

    return RayPacket(
        *(Floats, Ints, Vec3s, RaysStorage, packet_rays),
        *(ends_of, largest, take_coherent, begin_packet, slabs_of, enter_instance, visit_node),
    )
