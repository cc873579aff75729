"""Ray-mesh intersection: watertight ray-triangle tests, and the nearest triangle over all instances.

Corners are sheared so that the ray becomes an axis. The sign of a product then says on which side of an edge the ray
passes; both triangles of the edge compute the product from the same numbers (Woop, Benthin and Wald 2013). Kernels
that call these functions compile without fused multiply-adds (``fuse_fp``), which would round the two products
differently and make shared edges leak.

The equations are in docs/method/ray_tracing.md#triangles.
"""

import warp as wp

from lumisplat.constants import NODE_WIDTH, RAY_START_BACK
from lumisplat.device.bvh.nodes import (
    WIDTH,
    enter_boxes,
    first_lane,
    inverse_or_large,
    lanes_within,
    larger,
    lesser,
    load_node,
    nearest_entered,
    next_waiting,
)
from lumisplat.device.mesh.mesh_surface import hit_weights, passes_alpha_test
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import FAR, NO_CHILD, Children, MeshBvh, Node, TriangleLeaf
from lumisplat.device.structs.rays import MeshHits
from lumisplat.device.structs.scene import ALPHA_OPAQUE, MeshInstanceData


@struct
class RayShear:
    """Shear that maps a ray to a coordinate axis, for watertight triangle tests (Woop, Benthin and Wald 2013)."""

    axis: int
    """Index of the largest component of the ray's direction."""
    slope: wp.vec2
    """The direction's other two components, in cyclic order after ``axis``, divided by the component along ``axis``."""
    inverse: float
    """Reciprocal of the direction's component along ``axis``: ray distance per unit along the axis."""


@struct
class MeshRay:
    """A ray in world space or in the object space of a mesh instance; distances along it are world-space distances."""

    origin: wp.vec3
    direction: wp.vec3
    """Direction of the ray; in object space not unit, so that distances along it are world-space distances."""
    inverse: wp.vec3
    """``1 / x`` for each component x of the direction, limited to finite values."""
    shear: RayShear
    begin: float
    """World-space distance from the original ray's origin to the start of this ray, which lies close to the mesh's
    box."""


@struct
class MeshHit:
    """Nearest triangle found so far on one ray; fields as in ``MeshHits``."""

    t: float
    local_t: float
    """Distance from the start of the object-space ray to the hit; more precise than ``t``, to sort faces of one mesh.
    """
    face: int
    """Index of the hit triangle in its own mesh; -1: nothing was hit yet."""
    instance: int
    weights: wp.vec2


@struct
class Crossings:
    """Intersections of the infinite line of a ray with the triangles of a leaf, one lane for each triangle."""

    a: Children
    """Weights of the triangles' first corners, not normalised."""
    b: Children
    c: Children
    depth_a: Children
    """Offsets of the triangles' first corners from the ray's origin along the axis to which the ray is sheared."""
    depth_b: Children
    depth_c: Children


@struct
class TriangleHit:
    """Intersection of a ray with one triangle: distance and barycentric weights."""

    t: float
    """Distance along the ray."""
    weights: wp.vec2
    """Barycentric weights of the triangle's second and third corner at the hit."""


@wp.func
def axis_last(v: wp.vec3, axis: int) -> wp.vec3:
    """Permutes the components of a vector cyclically so that ``axis`` comes last."""
    # Component by component, because a vector that is written in branches goes through memory.
    x = wp.where(axis == 0, v[1], wp.where(axis == 1, v[2], v[0]))
    y = wp.where(axis == 0, v[2], wp.where(axis == 1, v[0], v[1]))
    return wp.vec3(x, y, wp.where(axis == 0, v[0], wp.where(axis == 1, v[1], v[2])))


@wp.func
def ray_shear(direction: wp.vec3) -> RayShear:
    """Returns the shear that maps a ray of this direction, of any length but zero, to a coordinate axis."""
    shear = RayShear()
    x = wp.abs(direction[0])
    y = wp.abs(direction[1])
    z = wp.abs(direction[2])
    # Without branches, which scattered rays would mispredict.
    shear.axis = wp.where(larger(y, z) > x, wp.where(z > y, 2, 1), 0)
    turned = axis_last(direction, shear.axis)
    shear.slope = wp.vec2(turned[0] / turned[2], turned[1] / turned[2])
    shear.inverse = 1.0 / turned[2]
    return shear


@wp.func
def edge_side(a: wp.vec2, b: wp.vec2) -> float:
    """Returns ``cross(a, b)``: its sign says on which side of the edge from ``a`` to ``b``, sheared, the ray passes.

    The two triangles of an edge get exactly opposite numbers.
    """
    return a[0] * b[1] - a[1] * b[0]


_LOAD_TURNED = """
constexpr int WIDTH = {width};
const int rows[3] = {(axis + 1) % 3 * WIDTH, (axis + 2) % 3 * WIDTH, axis * WIDTH};
const float* from = reinterpret_cast<const float*>(leaves.data + i);
float* to = reinterpret_cast<float*>(&leaf);
for (int corner = 0; corner < 3; ++corner)
    for (int k = 0; k < 3; ++k)
        for (int c = 0; c < WIDTH; ++c)
            to[(3 * corner + k) * WIDTH + c] = from[3 * corner * WIDTH + rows[k] + c];
"""


@wp.func_native(_LOAD_TURNED.replace("{width}", str(NODE_WIDTH)))
def load_turned(leaves: wp.array[TriangleLeaf], i: int, axis: int, leaf: wp.ref[TriangleLeaf]):
    """Reads the corners of leaf ``i``, each permuted as by `axis_last`; leaves out ``face``."""
    ...


@wp.func
def cross_triangles(leaf: wp.ref[TriangleLeaf], origin: wp.vec3, shear: RayShear, crossings: wp.ref[Crossings]) -> int:
    """Intersects the infinite line of a ray with the triangles of a leaf, from either side.

    ``leaf`` and ``origin`` are permuted as by `axis_last`. Returns the set of lanes, as a bit mask, whose triangles are
    hit.
    """
    a_x = leaf.a_x
    a_y = leaf.a_y
    a_z = leaf.a_z
    b_x = leaf.b_x
    b_y = leaf.b_y
    b_z = leaf.b_z
    c_x = leaf.c_x
    c_y = leaf.c_y
    c_z = leaf.c_z
    misses = Children()
    for c in range(WIDTH):
        depth_a = a_z[c] - origin[2]
        depth_b = b_z[c] - origin[2]
        depth_c = c_z[c] - origin[2]
        flat_a_x = (a_x[c] - origin[0]) - shear.slope[0] * depth_a
        flat_a_y = (a_y[c] - origin[1]) - shear.slope[1] * depth_a
        flat_b_x = (b_x[c] - origin[0]) - shear.slope[0] * depth_b
        flat_b_y = (b_y[c] - origin[1]) - shear.slope[1] * depth_b
        flat_c_x = (c_x[c] - origin[0]) - shear.slope[0] * depth_c
        flat_c_y = (c_y[c] - origin[1]) - shear.slope[1] * depth_c
        weight_a = flat_c_x * flat_b_y - flat_c_y * flat_b_x
        weight_b = flat_a_x * flat_c_y - flat_a_y * flat_c_x
        weight_c = flat_b_x * flat_a_y - flat_b_y * flat_a_x
        low = lesser(weight_a, lesser(weight_b, weight_c))
        high = larger(weight_a, larger(weight_b, weight_c))
        total = weight_a + weight_b + weight_c
        misses[c] = wp.where(total == 0.0, 1.0, wp.where(low < 0.0, wp.where(high > 0.0, 1.0, 0.0), 0.0))
        crossings.a[c] = weight_a
        crossings.b[c] = weight_b
        crossings.c[c] = weight_c
        crossings.depth_a[c] = depth_a
        crossings.depth_b[c] = depth_b
        crossings.depth_c[c] = depth_c
    return lanes_within(misses, 0.0)


@wp.func
def hit_of(crossings: wp.ref[Crossings], c: int, inverse: float) -> TriangleHit:
    """Returns where a ray hits the triangle in lane ``c`` of a leaf; ``inverse`` is that of the ray's shear.

    The distance is a weighted mean of the corners' distances, so that it stays between them even at grazing angles.
    """
    a = crossings.a[c]
    b = crossings.b[c]
    d = crossings.c[c]
    total = a + b + d
    hit = TriangleHit()
    hit.t = inverse * (a * crossings.depth_a[c] + b * crossings.depth_b[c] + d * crossings.depth_c[c]) / total
    hit.weights = wp.vec2(b / total, d / total)
    return hit


@wp.func
def flat_corner(corner: wp.vec3, origin: wp.vec3, shear: RayShear) -> wp.vec2:
    """Returns a triangle's corner relative to the ray, sheared and projected along the ray to two dimensions."""
    turned = axis_last(corner - origin, shear.axis)
    return wp.vec2(turned[0] - shear.slope[0] * turned[2], turned[1] - shear.slope[1] * turned[2])


@wp.func
def owns_edge(start: wp.vec2, end: wp.vec2, around: float) -> bool:
    """Returns whether a hit exactly on the edge from ``start`` to ``end`` counts for this triangle.

    ``around`` is positive for a counter-clockwise triangle. Of the two triangles at an edge, exactly one owns it, as if
    the ray passed slightly to the left of the edge.
    """
    if edge_side(start, end) != 0.0:
        return True
    along = around * (end - start)
    return along[1] > 0.0 or (along[1] == 0.0 and along[0] < 0.0)


@wp.func
def owns_crossing(origin: wp.vec3, shear: RayShear, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> bool:
    """Returns whether a hit counts for this triangle in a count of crossings; True inside of its edges.

    On an edge or a corner, the hit counts for exactly one of the triangles that meet there.
    """
    flat_a = flat_corner(v0, origin, shear)
    flat_b = flat_corner(v1, origin, shear)
    flat_c = flat_corner(v2, origin, shear)
    around = edge_side(flat_a, flat_b) + edge_side(flat_b, flat_c) + edge_side(flat_c, flat_a)
    if not owns_edge(flat_a, flat_b, around):
        return False
    return owns_edge(flat_b, flat_c, around) and owns_edge(flat_c, flat_a, around)


# --- Instances: boxes, and rays in object space ---

BACK = wp.constant(wp.float32(RAY_START_BACK))


@wp.func
def box_span(origin: wp.vec3, inverse: wp.vec3, low: wp.vec3, high: wp.vec3) -> wp.vec2:
    """Returns the distances, of any sign, at which the infinite line of a ray enters and leaves a box.

    ``inverse`` has ``1 / x`` for each component of the direction, limited to finite values.
    """
    ax = (low[0] - origin[0]) * inverse[0]
    bx = (high[0] - origin[0]) * inverse[0]
    ay = (low[1] - origin[1]) * inverse[1]
    by = (high[1] - origin[1]) * inverse[1]
    az = (low[2] - origin[2]) * inverse[2]
    bz = (high[2] - origin[2]) * inverse[2]
    near = larger(larger(lesser(ax, bx), lesser(ay, by)), lesser(az, bz))
    far = lesser(lesser(larger(ax, bx), larger(ay, by)), larger(az, bz))
    return wp.vec2(near, far)


@wp.func
def mesh_ray(origin: wp.vec3, direction: wp.vec3) -> MeshRay:
    """Returns a ray that starts at ``origin``, prepared for tests of boxes and triangles."""
    ray = MeshRay()
    ray.origin = origin
    ray.direction = direction
    ray.inverse = inverse_or_large(direction)
    ray.shear = ray_shear(direction)
    return ray


@wp.func
def ray_in_mesh(instance: MeshInstanceData, world: MeshRay, entry: float, t_min: float) -> MeshRay:
    """Transforms a ray from world space to the object space of a mesh instance.

    The ray starts at ``t_min`` or shortly before ``entry``, the distance at which it enters the instance's box. So
    close to the box, rounding errors are relative to the size of the box instead of the distance from the ray's origin.
    """
    begin = wp.max(entry - BACK * wp.abs(entry), t_min)
    start = world.origin - instance.position + begin * world.direction
    ray = world
    ray.origin = start
    if instance.keeps_directions == 0:
        ray = mesh_ray(instance.object_from_world * start, instance.object_from_world * world.direction)
    ray.begin = begin
    return ray


# --- The nearest triangle, through the two levels of the BVH ---
#
# Of equally near triangles, the one of the first instance counts, and within it the first face, so that the order of
# visits does not matter.


@wp.func
def is_nearer(t: float, local_t: float, face: int, instance: int, nearest: MeshHit) -> bool:
    """Returns whether a hit comes before the nearest hit so far: by distance, at equal ones by instance and face."""
    if t != nearest.t or nearest.face < 0:
        return t < nearest.t
    if instance != nearest.instance:
        return instance < nearest.instance
    return local_t < nearest.local_t or (local_t == nearest.local_t and face < nearest.face)


@wp.func
def keep_nearest(
    hit: TriangleHit,
    triangle: int,
    begin: float,
    number: int,
    t_min: float,
    sample_key: wp.uint32,
    scene: MeshBvh,
    nearest: wp.ref[MeshHit],
):
    """Stores a hit of a triangle of instance ``number`` if it is nearer than ``nearest``.

    ``begin`` is where the object-space ray starts, as in MeshRay.
    """
    t = begin + hit.t
    if t > t_min and is_nearer(t, hit.t, triangle, number, nearest):
        if scene.instances[number].alpha.mode != ALPHA_OPAQUE:
            face = scene.instances[number].face_first + triangle
            where = hit_weights(hit.weights)
            if not passes_alpha_test(scene.instances[number], scene.meshes, face, where, sample_key):
                return
        nearest.t = t
        nearest.local_t = hit.t
        nearest.face = triangle
        nearest.instance = number
        nearest.weights = hit.weights


@wp.func
def walk_instance(
    stack: wp.array[wp.uint64],
    bottom: int,
    number: int,
    world: MeshRay,
    t_min: float,
    sample_key: wp.uint32,
    scene: MeshBvh,
    nearest: wp.ref[MeshHit],
):
    """Finds the nearest triangle of mesh instance ``number`` on a ray, by traversing the BVH of its mesh.

    The traversal uses the stack entries from ``bottom`` on. ``nearest`` is changed only by a nearer hit.
    """
    span = box_span(world.origin, world.inverse, scene.instances[number].low, scene.instances[number].high)
    if not (span[0] <= span[1] and span[1] > t_min and span[0] <= nearest.t):
        return
    ray = ray_in_mesh(scene.instances[number], world, span[0], t_min)
    turned = axis_last(ray.origin, ray.shear.axis)
    nodes = scene.assets[scene.instances[number].asset].nodes
    leaves = scene.assets[scene.instances[number].asset].leaves
    node = Node()
    leaf = TriangleLeaf()
    crossings = Crossings()
    top = int(bottom)
    link = scene.instances[number].root
    while link != NO_CHILD:
        lanes = int(0)
        if link < 0:
            load_turned(leaves, ~link, ray.shear.axis, leaf)
            hits = cross_triangles(leaf, turned, ray.shear, crossings)
            while hits != 0:
                c = first_lane(hits)
                hits = hits & (hits - 1)
                hit = hit_of(crossings, c, ray.shear.inverse)
                keep_nearest(hit, leaves[~link].face[c], ray.begin, number, t_min, sample_key, scene, nearest)
        else:
            load_node(nodes, link, node)
            entries = enter_boxes(node, ray.origin, ray.inverse)
            lanes = lanes_within(entries, lesser(nearest.t - ray.begin, FAR))
            if lanes != 0:
                link = nearest_entered(stack, top, node.link, entries, lanes)
        if lanes == 0:
            link = next_waiting(stack, top, bottom, nearest.t - ray.begin)


@wp.func
def nearest_triangle(
    stack: wp.array[wp.uint64],
    origin: wp.vec3,
    direction: wp.vec3,
    t_min: float,
    t_max: float,
    sample_key: wp.uint32,
    scene: MeshBvh,
) -> MeshHit:
    """Returns the nearest triangle of all mesh instances that a ray hits between ``t_min`` and ``t_max``.

    Without a hit, ``t`` is ``t_max`` and ``face`` is -1.
    """
    nearest = MeshHit()
    nearest.t = t_max
    nearest.face = -1
    nearest.instance = -1
    world = mesh_ray(origin, direction)
    node = Node()
    top = int(0)
    link = int(0)
    while link != NO_CHILD:
        lanes = int(0)
        if link < 0:
            walk_instance(stack, top, scene.tlas_order[~link], world, t_min, sample_key, scene, nearest)
        else:
            load_node(scene.tlas_nodes, link, node)
            entries = enter_boxes(node, world.origin, world.inverse)
            lanes = lanes_within(entries, lesser(nearest.t, FAR))
            if lanes != 0:
                link = nearest_entered(stack, top, node.link, entries, lanes)
        if lanes == 0:
            link = next_waiting(stack, top, 0, nearest.t)
    return nearest


@wp.func
def store_hit(i: int, hit: MeshHit, scene: MeshBvh, hits_out: MeshHits):
    """Writes the nearest triangle on ray ``i``."""
    face = int(-1)
    if hit.face >= 0:
        face = scene.instances[hit.instance].face_first + hit.face
    hits_out.t[i] = hit.t
    hits_out.face[i] = face
    hits_out.instance[i] = hit.instance
    hits_out.weights[i] = hit.weights
