"""Packets: coherent rays that traverse the BVH together, their traversal stack, and their hit lists.

A packet has one lane for each ray. Loops over the lanes become vector instructions, so types and functions are built
for a fixed number of lanes: ``PACKET_RAYS`` on the CPU. On CUDA, a packet has one ray, and threads form groups instead.
"""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import warp as wp

from lumisplat.constants import FUSED_FLAGS, NODE_WIDTH
from lumisplat.device.bvh.nodes import (
    enter_child,
    enter_children,
    footprint_of_ray,
    footprint_slope,
    larger,
    lesser,
    mean_entries,
    mean_entry,
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
from lumisplat.device.structs.scene import SplatInstanceData

COHERENT_SPREAD = 0.15
"""A ray may join a packet if its unit direction differs from the first ray's by a vector of at most this length."""

# --- The nearest hits of a ray in blending order: by distance, then by index ---


@wp.func
def is_before(t: float, index: int, other_t: float, other_index: int) -> bool:
    """Returns whether hit (t, index) comes before another hit: by distance, or at equal distances by Gaussian index."""
    return t < other_t or (t == other_t and index < other_index)


@wp.func
def empty_list(begin: int) -> HitList:
    """Returns a hit list without hits, whose range of the shared array begins at ``begin``."""
    hit_list = HitList()
    hit_list.begin = begin
    hit_list.head = begin
    hit_list.tail = begin
    return hit_list


@wp.func
def buffer_hit(hits: wp.array[Hit], hit_list: wp.ref[HitList], slots: int, hit: Hit) -> Hit:
    """Inserts a hit into a list of at most ``slots`` hits; a full list drops its farthest hit.

    Returns:
        The dropped hit; its distance is FAR if no hit was dropped.
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
    """Moves the hits that a list still has to the start of its range, and so frees the places of blended hits."""
    shift = hit_list.head - hit_list.begin
    if shift > 0:
        for j in range(hit_list.head, hit_list.tail):
            hits[j - shift] = hits[j]
        hit_list.head -= shift
        hit_list.tail -= shift


@wp.func
def insert_hit(hits: wp.array[Hit], hit_list: wp.ref[HitList], hit: Hit):
    """Inserts a hit at its sorted position in a list; the element behind the list's last hit must be free."""
    head = hit_list.head
    j = int(hit_list.tail)
    while j > head and is_before(hit.t, hit.index, hits[j - 1].t, hits[j - 1].index):
        hits[j] = hits[j - 1]
        j -= 1
    hits[j] = hit
    hit_list.tail += 1


# --- Threads of a CUDA warp that traverse the BVH in step, as the lanes of a packet do on a CPU ---
#
# A group is a bit mask of the warp's lanes whose rays have similar origins and directions. Its threads decide by
# numbers that are reduced over the group here, so that all of them take the same branches. A thread on its own has
# group 0, as all threads on CPUs.

GROUP_MIN = NODE_WIDTH
"""CUDA threads with coherent rays traverse the BVH together only in groups of at least this many.

The threads of a smaller group visit more additional nodes than the group saves by sharing; and a group needs a thread
for each child of a node."""


def _on_cuda(code: str, otherwise: str) -> str:
    """Returns C++ code of a function body: ``code`` on CUDA and ``otherwise`` on CPUs."""
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

# Floats are mapped to integers of the same order, whose maximum is one hardware instruction from sm_80 on.
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
    """Returns the CUDA threads of this thread's warp that traverse the BVH with it, as a bit mask; 0: it goes alone.

    Each ray of a group starts within ``radius`` of the first ray's origin, and its direction differs from the first
    ray's by a vector of at most length ``spread``. All threads of the warp that have a ray must call the function
    together.
    """
    ...


@wp.func_native(_on_cuda(_LARGEST, "return number;"))
def largest_of(group: int, number: float) -> float:
    """Returns the largest ``number`` among the CUDA threads of a group, all of which must call the function."""
    ...


@wp.func
def least_of(group: int, number: float) -> float:
    """Returns the smallest ``number`` among the CUDA threads of a group, all of which must call the function."""
    return -largest_of(group, -number)


@wp.func
def largest_vector(group: int, numbers: wp.vec3) -> wp.vec3:
    """Returns the componentwise maximum of ``numbers`` over the CUDA threads of a group; all must call the function."""
    return wp.vec3(largest_of(group, numbers[0]), largest_of(group, numbers[1]), largest_of(group, numbers[2]))


@wp.func
def least_vector(group: int, numbers: wp.vec3) -> wp.vec3:
    """Returns the componentwise minimum of ``numbers`` over the CUDA threads of a group; all must call the function."""
    return -largest_vector(group, -numbers)


# All threads of a group have the same bounds, and would test the children of a node alike. So each tests one child.
_READ_CHILD = """
const unsigned before = (1u << (threadIdx.x & 31)) - 1u;
const int child = __popc(group & before) % WIDTH;
const auto* node = static_cast<decltype(nodes.data)>(__builtin_assume_aligned(nodes.data + link, 16));
const float* planes = reinterpret_cast<const float*>(node) + child;
for (int k = 0; k < 3; ++k) {
    low[k] = planes[WIDTH * k];
    high[k] = planes[WIDTH * (k + 3)];
}
links = node->link;
"""

_SHARE_ENTRIES = """
unsigned rest = group;
for (int child = 0; child < WIDTH; ++child) {
    entries[child] = __shfl_sync(group, entry, __ffs(rest) - 1);
    rest &= rest - 1;
}
"""


@wp.func_native(_on_cuda(_READ_CHILD.replace("WIDTH", str(NODE_WIDTH)), ""))
def read_child(
    nodes: wp.array[Node],
    link: int,
    group: int,
    low: wp.ref[wp.vec3],
    high: wp.ref[wp.vec3],
    links: wp.ref[ChildLinks],
):
    """Reads the corners of that child's box of node ``link`` which this thread of a group tests, and all links."""
    ...


@wp.func_native(_on_cuda(_SHARE_ENTRIES.replace("WIDTH", str(NODE_WIDTH)), ""))
def share_entries(group: int, entry: float, entries: wp.ref[Children]):
    """Collects the entry distances of a node's eight children; the threads of a group give those that they tested."""
    ...


# --- The traversal stack of a packet, with the next node on top ---

WIDTH = wp.constant(NODE_WIDTH)

NEAR_FIRST = wp.constant(wp.float32(1.0))
"""Visiting order of a BVH node's children: the child that rays enter first comes first."""

FAR_FIRST = wp.constant(wp.float32(-1.0))
"""Visiting order of a BVH node's children: the child that rays enter last comes first."""


@dataclass(frozen=True, slots=True)
class NodeStack:
    """Warp type and constructor of a packet's traversal stack, generated for one capacity."""

    storage: Any
    """Struct type of the kernel's local variable that holds the stack's memory."""
    node_stack: Any


@functools.cache
def node_stack_of(entries: int) -> NodeStack:
    """Builds the type and constructor of traversal stacks for up to ``entries`` nodes."""
    ENTRIES = entries
    NodeStackStorage = storage_of(WaitingNode, entries)

    @wp.func
    def node_stack(storage: wp.ref[NodeStackStorage]) -> wp.array[WaitingNode]:
        """Returns a traversal stack whose array points to the memory of the local variable ``storage``."""
        return wp.array(ptr=wp.address_of(storage), shape=(ENTRIES,), dtype=WaitingNode)

    return NodeStack(NodeStackStorage, node_stack)


@wp.func
def push_root(stack: wp.array[WaitingNode]) -> int:
    """Makes the root of the top-level tree the only entry of a packet's stack; returns the stack height, 1."""
    root = WaitingNode()
    root.instance = WORLD
    stack[0] = root
    return 1


@wp.func
def push_children(
    stack: wp.array[WaitingNode],
    top: wp.ref[int],
    leaves: wp.ref[ChildLinks],
    links: ChildLinks,
    instance: int,
    entries: Children,
    reach: float,
    order: float,
) -> int:
    """Pushes those children of a node that are nodes onto the packet's stack, and collects those that are leaves.

    ``leaves`` receives the leaves as indices of Gaussians in the particle array of the asset. Children that the packet
    enters beyond ``reach`` are skipped; ``order`` is NEAR_FIRST or FAR_FIRST.

    Returns:
        The number of leaves.
    """
    base = int(top)
    leaf_count = int(0)
    for c in range(WIDTH):
        # Rays without a direction enter all boxes, including those of empty children.
        if entries[c] <= reach and links[c] != NO_CHILD:
            if links[c] >= 0 or instance == WORLD:
                child = WaitingNode()
                child.entry = entries[c]
                # An instance is pushed as the root of its tree.
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
    """Inserts a node at its place in the visiting order among its siblings, stack entries ``base`` to ``top - 1``."""
    j = int(top)
    while j > base and order * stack[j - 1].entry < order * node.entry:
        stack[j] = stack[j - 1]
        j -= 1
    stack[j] = node


@wp.func
def set_floors(stack: wp.array[WaitingNode], base: int, top: int):
    """Sets ``floor`` of stack elements ``base`` to ``top - 1``: the smallest ``entry`` of the element and all below."""
    below = float(FAR)
    if base > 0:
        below = stack[base - 1].floor
    for j in range(base, top):
        stack[j].floor = lesser(stack[j].entry, below)


# --- Packets: selection of coherent rays, and traversal of the BVH ---

PACKET_OPTIONS = {
    "enable_backward": False,
    # Loops over lanes and children must stay loops for the vectoriser, and multiply-adds must be fused.
    "max_unroll": 4,
    "cpu_compiler_flags": FUSED_FLAGS,
}
"""Warp module options of kernels that trace packets of rays."""

PACKET_BOUNDS = (128, 4)
"""Launch bounds of CUDA kernels that trace packets: threads per block, and blocks at once.

With four blocks, each thread has 128 registers. The kernels would use up to twice as many, but more threads hide more
latency (primary rays on an H200, a million Gaussians: 86 ms instead of 103)."""

SPREAD_MAX = wp.constant(wp.float32(COHERENT_SPREAD))

load_node = aligned_load_of(Node)


@wp.func
def child_entries(nodes: wp.array[Node], link: int, slabs: Slabs, begin: float, hit_distance: int, end: float):
    """Returns the distances at which a packet enters the children of node ``link``, and their links."""
    node = Node()
    load_node(nodes, link, node)
    is_by_mean = hit_distance == HIT_MEAN
    entries = enter_children(node, slabs, wp.where(is_by_mean, 0.0, larger(begin, 0.0)))
    if is_by_mean:
        entries = mean_entries(node, slabs, entries, begin, end)
    return entries, node.link


@wp.func
def child_entries_of_group(
    nodes: wp.array[Node], link: int, group: int, slabs: Slabs, begin: float, hit_distance: int, end: float
):
    """Returns what ``child_entries`` does, on CUDA from all threads of a group, which test one child each."""
    low = wp.vec3()
    high = wp.vec3()
    links = ChildLinks()
    read_child(nodes, link, group, low, high, links)
    is_by_mean = hit_distance == HIT_MEAN
    entry = enter_child(low, high, slabs, wp.where(is_by_mean, 0.0, larger(begin, 0.0)))
    if is_by_mean:
        entry = mean_entry(low, high, slabs, entry, begin, end)
    entries = Children()
    share_entries(group, entry, entries)
    return entries, links


class RayPacket(NamedTuple):
    """Warp types and functions for packets, generated for one number of rays per packet."""

    floats: Any
    """Vector type with one float for each ray of a packet."""
    ints: Any
    vec3s: Any
    """Matrix type with rows x, y and z and one column for each ray of a packet."""
    rays_storage: Any
    """Struct type of the kernel's local variable that holds the memory of the arrays of PacketRays."""
    packet_rays: Any
    ends_of: Any
    largest: Any
    take_coherent: Any
    load_packet: Any
    begin_packet: Any
    slabs_of: Any
    move_rays: Any
    enter_instance: Any
    visit_node: Any


@functools.cache
def packet_of(lanes: int) -> RayPacket:
    """Builds the packet types and functions for up to ``lanes`` rays."""
    LANES = lanes
    Floats = wp.types.vector(length=lanes, dtype=wp.float32)
    Ints = wp.types.vector(length=lanes, dtype=wp.int32)
    Vec3s = wp.types.matrix(shape=(3, lanes), dtype=wp.float32)

    @struct
    class RaysStorage:
        """Local variable of a kernel that holds the memory of the arrays of PacketRays."""

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
        """Returns PacketRays whose arrays point to the memory of the local variable ``storage``."""
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
        """Returns the end distance of each ray from ``first`` on, at most FAR; -FAR: inactive, or the ray ends at 0."""
        ends = Floats(-FAR)
        for lane in range(LANES):
            if rays.is_active[first + lane] and limits[first + lane] > 0.0:
                ends[lane] = wp.min(limits[first + lane], FAR)
        return ends

    @wp.func
    def largest(numbers: Any) -> float:
        """Returns the largest element of a vector or array that has one number for each ray; at least -FAR."""
        most = float(-FAR)
        for lane in range(LANES):
            most = larger(most, numbers[lane])
        return most

    @wp.func
    def take_coherent(rays: RayData, first: int, waiting: wp.ref[Floats], radius_max: float) -> Floats:
        """Takes the first waiting ray and all waiting rays that are close to it in origin and direction.

        ``waiting`` has a positive number for each waiting ray; the numbers of the rays that are taken are set to -FAR.
        ``radius_max`` is the largest distance between origins.

        Returns:
            The previous elements of ``waiting`` for the rays that are taken, and -FAR for all others.
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
    def load_packet(packet: PacketRays, ends: Floats, rays: RayData, first: int):
        """Fills a packet with the rays from ``first`` on that end at ``ends``; -FAR: the ray is not in the packet."""
        for lane in range(LANES):
            packet.t_min[lane] = rays.t_min[first + lane]
            packet.t_max[lane] = ends[lane]
            packet.limit[lane] = ends[lane]
            packet.path_length[lane] = rays.path_length[first + lane]
            packet.spread[lane] = rays.spread[first + lane]

    @wp.func
    def begin_packet(packet: PacketRays, waiting: wp.ref[Floats], rays: RayData, first: int, radius_max: float):
        """Fills a packet with the first waiting ray and all waiting rays that are close to it.

        ``waiting`` has the end distance of each waiting ray, and -FAR for all others; rays that are taken no longer
        wait.
        """
        load_packet(packet, take_coherent(rays, first, waiting, radius_max), rays, first)

    @wp.func
    def slabs_of(packet: PacketRays) -> Slabs:
        """Returns the bounding volume of a packet's unfinished rays: a box around the origins that grows on its way.

        The volume includes the rays of the other CUDA threads of the group. It is widened by the footprints, because
        rays hit widened Gaussians (docs/method/ray_tracing.md#footprints).
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
    def move_rays(packet: PacketRays, instance: SplatInstanceData, rays: RayData, first: int):
        """Writes the packet's ray origins, directions and footprints in the object space of a splat instance."""
        for lane in range(LANES):
            packet.footprint[lane] = footprint_of_ray(instance.footprint, packet.spread[lane], instance.scale)
            o = instance.object_from_world * rays.origin[first + lane] + instance.object_from_world_offset
            d = instance.object_from_world * rays.direction[first + lane]
            for k in range(3):
                packet.origin[k, lane] = o[k]
                packet.direction[k, lane] = d[k]

    @wp.func
    def enter_instance(
        tree: wp.ref[PacketTree],
        packet: PacketRays,
        number: int,
        scene: SceneBvh,
        rays: RayData,
        first: int,
    ):
        """Switches the packet to the tree of instance ``number``, or to the top-level tree if ``number`` is WORLD.

        ``tree`` receives the new tree, ``packet`` the ray origins and directions in the space of the tree.
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
        group: int,
        begin: float,
        reach: float,
        order: float,
        hit_distance: int,
        end: float,
    ) -> int:
        """Tests the children of the node just popped from the packet's stack; pushes nodes and collects leaves.

        Children that the packet leaves before ``begin`` or enters beyond ``reach`` are skipped. With HIT_MEAN,
        ``reach`` limits the projections of means, and ``end`` is the distance at which the last ray of the packet ends.

        Returns:
            The number of leaves.
        """
        link = stack[top].link
        nodes = scene.tlas_nodes
        if tree.number != WORLD:
            nodes = scene.assets[tree.instance.asset].nodes
        entries = Children()
        links = ChildLinks()
        if group != 0:
            entries, links = child_entries_of_group(nodes, link, group, tree.slabs, begin, hit_distance, end)
        else:
            entries, links = child_entries(nodes, link, tree.slabs, begin, hit_distance, end)
        return push_children(stack, top, leaves, links, tree.number, entries, reach, order)

    return RayPacket(
        *(Floats, Ints, Vec3s, RaysStorage, packet_rays),
        *(ends_of, largest, take_coherent, load_packet, begin_packet, slabs_of, move_rays, enter_instance, visit_node),
    )
