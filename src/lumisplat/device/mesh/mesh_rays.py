"""Ray-mesh intersection: watertight ray-triangle tests, and the nearest triangle over all instances.

Corners are sheared so that the ray becomes an axis. The sign of a product then says on which side of an edge the ray
passes; both triangles of the edge compute the product from the same numbers (Woop, Benthin and Wald 2013). Kernels
that call these functions compile without fused multiply-adds (``fuse_fp``), which would round the two products
differently and make shared edges leak.

The equations are in docs/method/ray_tracing.md#triangles.
"""

import warp as wp

from lumisplat.constants import RAY_START_BACK
from lumisplat.device.bvh.nodes import enter_boxes, inverse_or_large, larger, lesser, load_node, push_entered, push_link
from lumisplat.device.mesh.mesh_surface import hit_weights, passes_alpha_test
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import MeshBvh, MeshTriangle, Node, WaitingLink
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
    """A ray in the object space of a mesh instance; distances along it are world-space distances."""

    origin: wp.vec3
    direction: wp.vec3
    """Direction of the ray in object space; not unit, so that distances along it are world-space distances."""
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
class TriangleHit:
    """Intersection of a ray with one triangle: distance and barycentric weights."""

    t: float
    """Distance along the ray; inf: the ray misses the triangle."""
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
    shear.axis = 2
    size = wp.vec3(wp.abs(direction[0]), wp.abs(direction[1]), wp.abs(direction[2]))
    if size[0] >= size[1] and size[0] >= size[2]:
        shear.axis = 0
    elif size[1] >= size[2]:
        shear.axis = 1
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


@wp.func
def intersect_triangle(
    origin: wp.vec3, direction: wp.vec3, shear: RayShear, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3
) -> TriangleHit:
    """Intersects the infinite line of a ray with a triangle, from either side.

    The distance is a weighted mean of the corners' distances, so that it stays between them even at grazing angles.
    """
    hit = TriangleHit()
    hit.t = wp.inf
    turned_a = axis_last(v0 - origin, shear.axis)
    turned_b = axis_last(v1 - origin, shear.axis)
    turned_c = axis_last(v2 - origin, shear.axis)
    flat_a = wp.vec2(turned_a[0] - shear.slope[0] * turned_a[2], turned_a[1] - shear.slope[1] * turned_a[2])
    flat_b = wp.vec2(turned_b[0] - shear.slope[0] * turned_b[2], turned_b[1] - shear.slope[1] * turned_b[2])
    flat_c = wp.vec2(turned_c[0] - shear.slope[0] * turned_c[2], turned_c[1] - shear.slope[1] * turned_c[2])
    weight_a = edge_side(flat_c, flat_b)
    weight_b = edge_side(flat_a, flat_c)
    weight_c = edge_side(flat_b, flat_a)
    if lesser(weight_a, lesser(weight_b, weight_c)) < 0.0 and larger(weight_a, larger(weight_b, weight_c)) > 0.0:
        return hit
    total = weight_a + weight_b + weight_c
    if total == 0.0:
        return hit
    hit.t = shear.inverse * (weight_a * turned_a[2] + weight_b * turned_b[2] + weight_c * turned_c[2]) / total
    hit.weights = wp.vec2(weight_b / total, weight_c / total)
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
    a = wp.cw_mul(low - origin, inverse)
    b = wp.cw_mul(high - origin, inverse)
    return wp.vec2(wp.max(wp.min(a, b)), wp.min(wp.max(a, b)))


@wp.func
def ray_in_mesh(instance: MeshInstanceData, origin: wp.vec3, direction: wp.vec3, entry: float, t_min: float) -> MeshRay:
    """Transforms a ray to the object space of a mesh instance.

    The ray starts at ``t_min`` or shortly before ``entry``, the distance at which it enters the instance's box. So
    close to the box, rounding errors are relative to the size of the box instead of the distance from the ray's origin.
    """
    ray = MeshRay()
    ray.begin = wp.max(entry - BACK * wp.abs(entry), t_min)
    ray.origin = instance.object_from_world * (origin - instance.position + ray.begin * direction)
    ray.direction = instance.object_from_world * direction
    ray.shear = ray_shear(ray.direction)
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
    triangle: MeshTriangle,
    ray: MeshRay,
    number: int,
    t_min: float,
    sample_key: wp.uint32,
    scene: MeshBvh,
    nearest: wp.ref[MeshHit],
):
    """Intersects a ray with a triangle of instance ``number``, and stores the hit if it is nearer than ``nearest``."""
    hit = intersect_triangle(ray.origin, ray.direction, ray.shear, triangle.a, triangle.b, triangle.c)
    t = ray.begin + hit.t
    if t > t_min and is_nearer(t, hit.t, triangle.face, number, nearest):
        if scene.instances[number].alpha.mode != ALPHA_OPAQUE:
            face = scene.instances[number].face_first + triangle.face
            where = hit_weights(hit.weights)
            if not passes_alpha_test(scene.instances[number], scene.meshes, face, where, sample_key):
                return
        nearest.t = t
        nearest.local_t = hit.t
        nearest.face = triangle.face
        nearest.instance = number
        nearest.weights = hit.weights


@wp.func
def walk_instance(
    stack: wp.array[WaitingLink],
    top: int,
    number: int,
    origin: wp.vec3,
    direction: wp.vec3,
    t_min: float,
    sample_key: wp.uint32,
    scene: MeshBvh,
    nearest: wp.ref[MeshHit],
):
    """Finds the nearest triangle of mesh instance ``number`` on a ray, by traversing the BVH of its mesh.

    The traversal uses the stack entries from ``top`` on. ``nearest`` is changed only by a nearer hit.
    """
    span = box_span(origin, inverse_or_large(direction), scene.instances[number].low, scene.instances[number].high)
    if not (span[0] <= span[1] and span[1] > t_min and span[0] <= nearest.t):
        return
    ray = ray_in_mesh(scene.instances[number], origin, direction, span[0], t_min)
    inverse = inverse_or_large(ray.direction)
    asset = scene.instances[number].asset
    node = Node()
    height = int(top)
    push_link(stack, height, scene.instances[number].root)
    while height > top:
        height -= 1
        reach = nearest.t - ray.begin
        if stack[height].entry <= reach:
            link = stack[height].link
            if link < 0:
                keep_nearest(scene.assets[asset].triangles[~link], ray, number, t_min, sample_key, scene, nearest)
            else:
                load_node(scene.assets[asset].nodes, link, node)
                push_entered(stack, height, node, enter_boxes(node, ray.origin, inverse), reach)


@wp.func
def nearest_triangle(
    stack: wp.array[WaitingLink],
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
    inverse = inverse_or_large(direction)
    node = Node()
    top = int(0)
    push_link(stack, top, 0)
    while top > 0:
        top -= 1
        if stack[top].entry <= nearest.t:
            link = stack[top].link
            if link < 0:
                walk_instance(stack, top, scene.tlas_order[~link], origin, direction, t_min, sample_key, scene, nearest)
            else:
                load_node(scene.tlas_nodes, link, node)
                push_entered(stack, top, node, enter_boxes(node, origin, inverse), nearest.t)
    return nearest
