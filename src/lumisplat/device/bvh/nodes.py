"""BVH nodes: slab tests of packets and single rays against child boxes, traversal stacks, and ray footprints.

A packet is bounded by a box around its ray origins that grows with distance: along each axis, its two sides move with
the slowest and the fastest ray. Relative to this moving box, each of a child box's six planes bounds the packet's
distances by a linear inequality. A single ray is a packet of zero width.

The equations are in docs/method/ray_tracing.md#traversal.
"""

import warp as wp

from lumisplat.constants import NODE_WIDTH, TRAVERSE_STACK
from lumisplat.device.math.memory import aligned_load_of, from_zero, storage_of
from lumisplat.device.structs.bvh import (
    FAR,
    HIT_MEAN,
    NO_CHILD,
    ChildLinks,
    Children,
    Node,
    Slabs,
    TreeRay,
    WaitingLink,
)

TRAVERSE_MARGIN = 1e-6
"""Rays are widened by this fraction of the distance and of their origin's coordinates, so that rounding misses no box.
"""

FOOTPRINT_REACH = 3.7
"""Rays hit a Gaussian at most this many standard deviations from its mean, whatever its kernel degree and opacity."""

FOOTPRINT_LEAD = 1.1
"""A ray widens a Gaussian by at most this factor times the ray's footprint where the Gaussian's ellipsoid begins.

Up to this limit, the Gaussian is widened by the footprint at its mean. With the limit, the boxes of nodes need not be
widened by more than the ray's footprint at the box."""

FOOTPRINT_MAX = 0.1
"""Largest footprint, as a standard deviation over path length, by which rays widen Gaussians; practical footprints are
smaller."""

WIDTH = wp.constant(NODE_WIDTH)

MARGIN = wp.constant(wp.float32(TRAVERSE_MARGIN))

SLOPE_MIN = wp.constant(wp.float32(1.0e-9))


@wp.func
def lesser(a: float, b: float) -> float:
    """Returns the smaller number, without the NaN handling that keeps ``wp.min`` from vectorising."""
    return wp.where(a < b, a, b)


@wp.func
def larger(a: float, b: float) -> float:
    """Returns the larger number, without the NaN handling that keeps ``wp.max`` from vectorising."""
    return wp.where(a > b, a, b)


@wp.func
def slabs_around(low: wp.vec3, high: wp.vec3, slow: wp.vec3, fast: wp.vec3) -> Slabs:
    """Computes the bounding volume of a packet of rays for slab tests.

    ``low`` and ``high`` are the corners of a box around the ray origins; ``slow`` and ``fast`` are the smallest and
    largest components of the directions. A plane with slope s, ``s t <= b``, means t <= b / s or, for s < 0, t >= b /
    s.
    """
    slabs = Slabs()
    width = wp.vec3(MARGIN * wp.max(wp.max(wp.abs(low)), wp.max(wp.abs(high))))
    slabs.low = low - width
    slabs.high = high + width
    speed = wp.max(wp.max(wp.abs(slow)), wp.max(wp.abs(fast)))
    least = SLOPE_MIN * speed
    for k in range(3):
        up = slow[k] - MARGIN * speed
        if wp.abs(up) < least:
            up = -least
        down = -fast[k] - MARGIN * speed
        if wp.abs(down) < least:
            down = -least
        slabs.up_far[k] = wp.where(up > 0.0, 1.0 / up, 0.0)
        slabs.up_far_void[k] = wp.where(up > 0.0, 0.0, FAR)
        slabs.up_near[k] = wp.where(up < 0.0, 1.0 / up, 0.0)
        slabs.up_near_void[k] = wp.where(up < 0.0, 0.0, -FAR)
        slabs.down_far[k] = wp.where(down > 0.0, 1.0 / down, 0.0)
        slabs.down_far_void[k] = wp.where(down > 0.0, 0.0, FAR)
        slabs.down_near[k] = wp.where(down < 0.0, 1.0 / down, 0.0)
        slabs.down_near_void[k] = wp.where(down < 0.0, 0.0, -FAR)
    return slabs


@wp.func
def enter_child(low: wp.vec3, high: wp.vec3, slabs: Slabs, begin: float) -> float:
    """Returns a lower bound of the distance at which a ray of the packet is inside a child's box.

    The bound is 2 FAR if no ray enters the box, or if all rays leave the box before ``begin``. It is -FAR if rays may
    start inside, because slabs do not bound the space behind the origins.
    """
    ax = high[0] - slabs.low[0]
    bx = slabs.high[0] - low[0]
    ay = high[1] - slabs.low[1]
    by = slabs.high[1] - low[1]
    az = high[2] - slabs.low[2]
    bz = slabs.high[2] - low[2]
    far = lesser(
        ax * slabs.up_far[0] + slabs.up_far_void[0],
        bx * slabs.down_far[0] + slabs.down_far_void[0],
    )
    far = lesser(far, ay * slabs.up_far[1] + slabs.up_far_void[1])
    far = lesser(far, by * slabs.down_far[1] + slabs.down_far_void[1])
    far = lesser(far, az * slabs.up_far[2] + slabs.up_far_void[2])
    far = lesser(far, bz * slabs.down_far[2] + slabs.down_far_void[2])
    near = larger(
        ax * slabs.up_near[0] + slabs.up_near_void[0],
        bx * slabs.down_near[0] + slabs.down_near_void[0],
    )
    near = larger(near, ay * slabs.up_near[1] + slabs.up_near_void[1])
    near = larger(near, by * slabs.down_near[1] + slabs.down_near_void[1])
    near = larger(near, az * slabs.up_near[2] + slabs.up_near_void[2])
    near = larger(near, bz * slabs.down_near[2] + slabs.down_near_void[2])
    near = near - MARGIN * wp.abs(near)
    far = far + MARGIN * wp.abs(far)
    entry = wp.where(near > 0.0, near, -FAR)
    return wp.where(lesser(far - near, far - begin) >= 0.0, entry, 2.0 * FAR)


@wp.func
def mean_entry(low: wp.vec3, high: wp.vec3, slabs: Slabs, entry: float, begin: float, end: float) -> float:
    """Returns a lower bound of the distances at which Gaussians' means in a child's box project onto a ray.

    ``entry`` is the distance at which rays enter the box. The bound is 2 FAR if no ray enters the box before ``end``,
    or if all means in the box project before ``begin``.
    """
    ax = low[0] - slabs.high[0]
    bx = high[0] - slabs.low[0]
    ay = low[1] - slabs.high[1]
    by = high[1] - slabs.low[1]
    az = low[2] - slabs.high[2]
    bz = high[2] - slabs.low[2]
    x = least_product(ax, bx, slabs.slow[0], slabs.fast[0])
    y = least_product(ay, by, slabs.slow[1], slabs.fast[1])
    z = least_product(az, bz, slabs.slow[2], slabs.fast[2])
    farthest = -least_product(ax, bx, -slabs.fast[0], -slabs.slow[0])
    farthest = farthest - least_product(ay, by, -slabs.fast[1], -slabs.slow[1])
    farthest = farthest - least_product(az, bz, -slabs.fast[2], -slabs.slow[2])
    margin = MARGIN * (wp.abs(x) + wp.abs(y) + wp.abs(z) + wp.abs(farthest))
    return wp.where(lesser(end - entry, farthest + margin - begin) >= 0.0, x + y + z - margin, 2.0 * FAR)


@wp.func
def enter_children(node: Node, slabs: Slabs, begin: float) -> Children:
    """Returns ``enter_child`` of each child box.

    The loop over the children becomes vector instructions; for this reason each side of the boxes is a local vector.
    """
    entries = Children()
    low_x = node.low_x
    low_y = node.low_y
    low_z = node.low_z
    high_x = node.high_x
    high_y = node.high_y
    high_z = node.high_z
    for c in range(WIDTH):
        low = wp.vec3(low_x[c], low_y[c], low_z[c])
        high = wp.vec3(high_x[c], high_y[c], high_z[c])
        entries[c] = enter_child(low, high, slabs, begin)
    return entries


@wp.func
def mean_entries(node: Node, slabs: Slabs, entries: Children, begin: float, end: float) -> Children:
    """Returns ``mean_entry`` of each child box, which the packet enters at ``entries``."""
    low_x = node.low_x
    low_y = node.low_y
    low_z = node.low_z
    high_x = node.high_x
    high_y = node.high_y
    high_z = node.high_z
    for c in range(WIDTH):
        low = wp.vec3(low_x[c], low_y[c], low_z[c])
        high = wp.vec3(high_x[c], high_y[c], high_z[c])
        entries[c] = mean_entry(low, high, slabs, entries[c], begin, end)
    return entries


@wp.func
def least_product(a: float, b: float, c: float, d: float) -> float:
    """Returns the smallest x y with x between ``a`` and ``b``, and y between ``c`` and ``d``."""
    return lesser(lesser(a * c, a * d), lesser(b * c, b * d))


# --- Ray footprints (docs/method/ray_tracing.md#footprints) ---

LEAD = wp.constant(wp.float32(FOOTPRINT_LEAD))

REACH = wp.constant(wp.float32(FOOTPRINT_REACH))

WIDEST = wp.constant(wp.float32(FOOTPRINT_MAX))


@wp.func
def footprint_of_ray(footprint: float, spread: float, scale: float) -> float:
    """Returns the standard deviation by which a ray widens Gaussians, object space, divided by the path length.

    ``footprint`` is the standard deviation in pixel widths, ``spread`` the pixel width over the path length, and
    ``scale`` the uniform scale from object to world.
    """
    return lesser(footprint * spread, WIDEST) / scale


@wp.func
def footprint_slope(footprint: float, length: float) -> float:
    """Returns the slope of the cone around a ray that contains the boxes of all Gaussians which the ray hits.

    ``footprint`` is the standard deviation by which the ray widens Gaussians, divided by the path length; ``length`` is
    the length of the ray's direction.
    """
    ahead = LEAD * REACH * footprint
    return ahead / (1.0 - ahead / length)


@wp.func
def footprint_variance(footprint: float, path: float, largest_scale: float) -> float:
    """Returns the variance by which a ray widens a Gaussian, object space: its squared footprint at the mean.

    ``footprint`` is a standard deviation over the path length, ``path`` the path length to the projection of the mean.
    Where an ellipsoid of ``largest_scale``, world space, may begin long before its mean, the smaller footprint near
    that beginning is used instead: the boxes of nodes then need not be wider than the footprints of their rays.
    """
    width = footprint * larger(lesser(path, LEAD * (path - REACH * largest_scale)), 0.0)
    return width * width


@wp.func
def footprint_slopes(footprint: float, path: float, largest_scale: float) -> wp.vec2:
    """Returns the derivatives of ``footprint_variance`` with respect to ``path`` and to ``largest_scale``."""
    nearer = LEAD * (path - REACH * largest_scale)
    width = footprint * larger(lesser(path, nearer), 0.0)
    if path <= nearer:
        return wp.vec2(2.0 * width * footprint, 0.0)
    by_path = 2.0 * width * footprint * LEAD
    return wp.vec2(by_path, -REACH * by_path)


# --- Single rays, with one lane for each child of a node ---
#
# Incoherent rays share no nodes: a packet of them would visit the union of all their nodes. The children of a node fill
# the lanes of a vector register as well as rays do (Wald, Benthin and Boulos 2008).

SHORTER = wp.constant(wp.float32(1.0 - TRAVERSE_MARGIN))

LONGER = wp.constant(wp.float32(1.0 + TRAVERSE_MARGIN))

ENTRIES = wp.constant(TRAVERSE_STACK)

LinkStackStorage = storage_of(WaitingLink, TRAVERSE_STACK)

load_node = aligned_load_of(Node)


@wp.func
def link_stack(storage: wp.ref[LinkStackStorage]) -> wp.array[WaitingLink]:
    """Returns a single ray's traversal stack, whose array points to the memory of the local variable ``storage``."""
    return wp.array(ptr=wp.address_of(storage), shape=(ENTRIES,), dtype=WaitingLink)


@wp.func
def push_link(stack: wp.array[WaitingLink], top: wp.ref[int], link: int):
    """Pushes a node or leaf onto a single ray's stack as the next to visit; entry distance -FAR: it is not skipped."""
    waiting = WaitingLink()
    waiting.entry = -FAR
    waiting.link = link
    stack[top] = waiting
    top += 1


@wp.func
def inverse_or_large(v: wp.vec3) -> wp.vec3:
    """Returns ``1 / x`` for each component of a vector; 1e30 where x is 0 or almost 0."""
    return wp.vec3(
        wp.where(wp.abs(v[0]) > 1.0e-30, 1.0 / v[0], 1.0e30),
        wp.where(wp.abs(v[1]) > 1.0e-30, 1.0 / v[1], 1.0e30),
        wp.where(wp.abs(v[2]) > 1.0e-30, 1.0 / v[2], 1.0e30),
    )


@wp.func
def enter_boxes(node: Node, origin: wp.vec3, inverse: wp.vec3) -> Children:
    """Returns the distance, at least 0, at which a ray enters each child box of a node; 2 FAR if it misses the box.

    ``inverse`` has ``1 / x`` for each component of the ray's direction in the space of the tree, limited to finite
    values.
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
        # An empty child has an inverted box, which only the order of its planes reveals.
        inside = lesser(LONGER * far - entry, high_x[c] - low_x[c])
        entries[c] = wp.where(inside >= 0.0, entry, 2.0 * FAR)
    return entries


@wp.func
def tree_ray(origin: wp.vec3, direction: wp.vec3, footprint: float, path_length: float, hit_distance: int) -> TreeRay:
    """Sets up a single ray for traversal of one BVH, in the space of that BVH.

    ``footprint`` is the standard deviation by which the ray widens Gaussians, in the space of the tree, divided by the
    path length.
    """
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
    """Returns, for each child of a node, a lower bound of the ray's hit distances in it; 2 FAR: none before ``end``."""
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
    """Pushes the children of a node that a single ray enters before ``reach``, in the order of storage."""
    links = node.link
    end = int(top)
    last = lesser(reach, FAR)
    for c in range(WIDTH):
        # Always written, and overwritten if skipped, so that no branch can be mispredicted.
        stack[end].entry = entries[c]
        stack[end].link = links[c]
        end += wp.where(entries[c] <= last, 1, 0)
    top = end


@wp.func
def push_entered(stack: wp.array[WaitingLink], top: wp.ref[int], node: Node, entries: Children, reach: float):
    """Pushes the children of a node that a single ray enters before ``reach``, so that the nearest is visited next."""
    base = int(top)
    push_all_entered(stack, top, node, entries, reach)
    for k in range(base + 1, top):
        waiting = stack[k]
        j = int(k)
        while j > base and stack[j - 1].entry < waiting.entry:
            stack[j] = stack[j - 1]
            j -= 1
        stack[j] = waiting


# --- Single rays through meshes: sets of lanes, and stacks of words ---
#
# The nearest child that a ray enters is visited next without being stored; only the others wait.

WordStackStorage = wp.types.vector(length=TRAVERSE_STACK, dtype=wp.uint64)

UnsortedStackStorage = wp.types.vector(length=TRAVERSE_STACK, dtype=wp.int32)

LOW_WORD = wp.constant(wp.uint64(2**32 - 1))


@wp.func
def word_stack(storage: wp.ref[WordStackStorage]) -> wp.array[wp.uint64]:
    """Returns a traversal stack of words, whose array points to the memory of the local variable ``storage``."""
    return wp.array(ptr=wp.address_of(storage), shape=(ENTRIES,), dtype=wp.uint64)


@wp.func
def unsorted_stack(storage: wp.ref[UnsortedStackStorage]) -> wp.array[int]:
    """Returns a traversal stack of links, whose array points to the memory of the local variable ``storage``."""
    return wp.array(ptr=wp.address_of(storage), shape=(ENTRIES,), dtype=int)


@wp.func_native("#if defined(__CUDA_ARCH__)\nreturn __ffs(mask) - 1;\n#else\nreturn __builtin_ctz(mask);\n#endif\n")
def first_lane(mask: int) -> int:
    """Returns the lowest bit that is set in ``mask``, which is not 0: the first of a set of lanes."""
    ...


_LANES_WITHIN = """
#if defined(__CUDA_ARCH__)
int lanes = 0;
for (int c = 0; c < WIDTH; ++c)
    lanes |= (values[c] <= limit) << c;
return lanes;
#else
typedef float Floats __attribute__((ext_vector_type(WIDTH)));
typedef bool Flags __attribute__((ext_vector_type(WIDTH)));
const Floats numbers = __builtin_bit_cast(Floats, values);
return __builtin_bit_cast(unsigned char, __builtin_convertvector(numbers <= limit, Flags));
#endif
"""


@wp.func_native(_LANES_WITHIN.replace("WIDTH", str(NODE_WIDTH)))
def lanes_within(values: Children, limit: float) -> int:
    """Returns the set of lanes, as a bit mask, whose value is at most ``limit``."""
    ...


@wp.func
def waiting_word(entry: float, link: int) -> wp.uint64:
    """Returns an entry of a stack of words: sorted by distance of entry, which is not negative, then by link."""
    return (wp.uint64(wp.cast(entry, wp.uint32)) << wp.uint64(32)) | wp.uint64(wp.cast(link, wp.uint32))


@wp.func
def nearest_entered(
    stack: wp.array[wp.uint64], top: wp.ref[int], links: ChildLinks, entries: Children, lanes: int
) -> int:
    """Returns the link of the child in ``lanes`` that a ray enters first; pushes the others, the nearest on top.

    ``lanes`` is the set of entered children, not empty.
    """
    base = int(top)
    c = first_lane(lanes)
    nearest = waiting_word(entries[c], links[c])
    rest = lanes & (lanes - 1)
    while rest != 0:
        c = first_lane(rest)
        rest = rest & (rest - 1)
        word = waiting_word(entries[c], links[c])
        other = wp.where(word < nearest, nearest, word)
        nearest = wp.where(word < nearest, word, nearest)
        j = int(top)
        while j > base and stack[from_zero(j - 1)] < other:
            stack[from_zero(j)] = stack[from_zero(j - 1)]
            j -= 1
        stack[from_zero(j)] = other
        top += 1
    return int(wp.uint32(nearest & LOW_WORD))


@wp.func
def next_waiting(stack: wp.array[wp.uint64], top: wp.ref[int], bottom: int, reach: float) -> int:
    """Returns the link on top of a stack that a ray enters before ``reach``, and pops it and all links above it.

    NO_CHILD: no link above ``bottom`` is left.
    """
    while top > bottom:
        top -= 1
        word = stack[from_zero(top)]
        if wp.cast(wp.uint32(word >> wp.uint64(32)), wp.float32) <= reach:
            return int(wp.uint32(word & LOW_WORD))
    return NO_CHILD


@wp.func
def push_lanes(stack: wp.array[int], top: wp.ref[int], links: ChildLinks, lanes: int):
    """Pushes the links of the children in ``lanes``, in the order of storage."""
    rest = int(lanes)
    while rest != 0:
        stack[from_zero(top)] = links[first_lane(rest)]
        rest = rest & (rest - 1)
        top += 1
