"""How a single ray visits nodes, with one lane for each of their children.

Incoherent rays share no nodes: a packet of them visits what any of its rays does. The children of a node fill the lanes
of a vector register as well as rays do (Wald, Benthin and Boulos 2008).
"""

import warp as wp

from lumisplat.constants import NODE_WIDTH, TRAVERSE_MARGIN, TRAVERSE_STACK
from lumisplat.device.bvh.footprint import footprint_slope
from lumisplat.device.bvh.local_arrays import storage_of
from lumisplat.device.bvh.node_test import enter_children, larger, lesser, mean_entries, slabs_around
from lumisplat.device.math.aligned_memory import aligned_load_of
from lumisplat.device.structs.bvh import FAR, HIT_MEAN, Children, Node
from lumisplat.device.structs.packet import TreeRay, WaitingLink

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

WIDTH = wp.constant(NODE_WIDTH)
SHORTER = wp.constant(wp.float32(1.0 - TRAVERSE_MARGIN))
LONGER = wp.constant(wp.float32(1.0 + TRAVERSE_MARGIN))
ENTRIES = wp.constant(TRAVERSE_STACK)

LinkStackStorage = storage_of(WaitingLink, TRAVERSE_STACK)

load_node = aligned_load_of(Node)


@wp.func
def link_stack(storage: wp.ref[LinkStackStorage]) -> wp.array[WaitingLink]:
    """The stack whose links lie in a variable."""
    return wp.array(ptr=wp.address_of(storage), shape=(ENTRIES,), dtype=WaitingLink)


@wp.func
def push_link(stack: wp.array[WaitingLink], top: wp.ref[int], link: int):
    """Makes a link the next one, wherever its box is."""
    waiting = WaitingLink()
    waiting.entry = -FAR
    waiting.link = link
    stack[top] = waiting
    top += 1


@wp.func
def inverse_or_large(v: wp.vec3) -> wp.vec3:
    """``1 / x`` of each component, finite."""
    return wp.vec3(
        wp.where(wp.abs(v[0]) > 1.0e-30, 1.0 / v[0], 1.0e30),
        wp.where(wp.abs(v[1]) > 1.0e-30, 1.0 / v[1], 1.0e30),
        wp.where(wp.abs(v[2]) > 1.0e-30, 1.0 / v[2], 1.0e30),
    )


@wp.func
def enter_boxes(node: Node, origin: wp.vec3, inverse: wp.vec3) -> Children:
    """Where a ray enters the boxes of a node's children, at least 0; 2 FAR: it does not.

    Args:
        node: The node.
        origin: Of the ray, in the space of the tree.
        inverse: Of the components of its direction, finite.
    """
    entries = Children()
    low_x = node.low_x
    low_y = node.low_y
    low_z = node.low_z
    high_x = node.high_x
    high_y = node.high_y
    high_z = node.high_z
    for c in range(WIDTH):
        ax = (low_x[c] - origin[0]) * inverse[0]
        bx = (high_x[c] - origin[0]) * inverse[0]
        ay = (low_y[c] - origin[1]) * inverse[1]
        by = (high_y[c] - origin[1]) * inverse[1]
        az = (low_z[c] - origin[2]) * inverse[2]
        bz = (high_z[c] - origin[2]) * inverse[2]
        near = larger(larger(lesser(ax, bx), lesser(ay, by)), lesser(az, bz))
        far = lesser(lesser(larger(ax, bx), larger(ay, by)), larger(az, bz))
        entry = SHORTER * larger(near, 0.0)
        # An empty child has an inverted box, which is told by its order of planes alone.
        inside = lesser(LONGER * far - entry, high_x[c] - low_x[c])
        entries[c] = wp.where(inside >= 0.0, entry, 2.0 * FAR)
    return entries


@wp.func
def tree_ray(origin: wp.vec3, direction: wp.vec3, footprint: float, path_length: float, hit_distance: int) -> TreeRay:
    """A ray of which the footprint, over the length of its path, is in the space of the tree."""
    ray = TreeRay()
    ray.origin = origin
    ray.direction = direction
    ray.inverse = inverse_or_large(direction)
    ray.footprint = footprint
    ray.path_length = path_length
    if footprint > 0.0 or hit_distance == HIT_MEAN:
        length2 = wp.length_sq(direction)
        slope = wp.vec3(footprint_slope(footprint, wp.sqrt(length2)))
        around = path_length * slope
        ray.slabs = slabs_around(origin - around, origin + around, direction - slope, direction + slope)
        ray.slabs.slow = direction / length2
        ray.slabs.fast = direction / length2
    return ray


@wp.func
def enter_tree(node: Node, ray: TreeRay, hit_distance: int, end: float) -> Children:
    """Distances before which no Gaussian of a node's children is hit; 2 FAR: none is before ``end``."""
    entries = Children()
    if ray.footprint > 0.0:
        entries = enter_children(node, ray.slabs, 0.0)
    else:
        entries = enter_boxes(node, ray.origin, ray.inverse)
    if hit_distance == HIT_MEAN:
        entries = mean_entries(node, ray.slabs, entries, -FAR, end)
    return entries


@wp.func
def push_all_entered(stack: wp.array[WaitingLink], top: wp.ref[int], node: Node, entries: Children, reach: float):
    """Pushes the children that a ray enters up to ``reach``, as they come."""
    links = node.link
    end = int(top)
    last = lesser(reach, FAR)
    for c in range(WIDTH):
        # Written in any case, and overwritten: no branch to be mispredicted.
        stack[end].entry = entries[c]
        stack[end].link = links[c]
        end += wp.where(entries[c] <= last, 1, 0)
    top = end


@wp.func
def push_entered(stack: wp.array[WaitingLink], top: wp.ref[int], node: Node, entries: Children, reach: float):
    """The same, the nearest last, so that it is next."""
    base = int(top)
    push_all_entered(stack, top, node, entries, reach)
    for k in range(base + 1, top):
        waiting = stack[k]
        j = int(k)
        while j > base and stack[j - 1].entry < waiting.entry:
            stack[j] = stack[j - 1]
            j -= 1
        stack[j] = waiting
