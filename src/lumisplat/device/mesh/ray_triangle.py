"""A ray against one triangle, watertight (Woop, Benthin and Wald 2013).

Corners are sheared so that the ray becomes an axis; which side of an edge it passes is then the sign of a product that
both triangles of the edge compute from the same numbers.

The equations are in docs/method/ray_tracing.md#triangles.
"""

import warp as wp

from lumisplat.device.bvh.node_test import larger, lesser
from lumisplat.device.structs.rays import RayShear, TriangleHit

# Fused multiply-adds would round the two products of an edge differently, and shared edges leak.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def axis_last(v: wp.vec3, axis: int) -> wp.vec3:
    """The vector's components, permuted cyclically so that ``axis`` comes last."""
    # Component by component: a vector that is written in branches goes through memory.
    x = wp.where(axis == 0, v[1], wp.where(axis == 1, v[2], v[0]))
    y = wp.where(axis == 0, v[2], wp.where(axis == 1, v[0], v[1]))
    return wp.vec3(x, y, wp.where(axis == 0, v[0], wp.where(axis == 1, v[1], v[2])))


@wp.func
def ray_shear(direction: wp.vec3) -> RayShear:
    """How to shear corners so that a direction, of any length but zero, becomes an axis."""
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
    """On which side of an edge the ray passes; the two triangles of the edge get exactly opposite numbers."""
    return a[0] * b[1] - a[1] * b[0]


@wp.func
def intersect_triangle(
    origin: wp.vec3, direction: wp.vec3, shear: RayShear, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3
) -> TriangleHit:
    """The hit of the ray's line on a triangle, from either side.

    Its distance is a weighted mean of those of the corners: bounded by them, at grazing angles, too.
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
    """A corner, sheared and projected along the ray."""
    turned = axis_last(corner - origin, shear.axis)
    return wp.vec2(turned[0] - shear.slope[0] * turned[2], turned[1] - shear.slope[1] * turned[2])


@wp.func
def owns_edge(start: wp.vec2, end: wp.vec2, around: float) -> bool:
    """Whether a triangle owns the points on its edge; ``around`` is positive if it is counter-clockwise, else negative.

    Of the two triangles at an edge, one does: as if the ray passed slightly to the left of the edge.
    """
    if edge_side(start, end) != 0.0:
        return True
    along = around * (end - start)
    return along[1] > 0.0 or (along[1] == 0.0 and along[0] < 0.0)


@wp.func
def owns_crossing(origin: wp.vec3, shear: RayShear, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> bool:
    """Whether a triangle counts that a ray hits exactly on an edge or a corner.

    Otherwise, a count of crossings would include each triangle at the edge, or all around the corner.
    """
    flat_a = flat_corner(v0, origin, shear)
    flat_b = flat_corner(v1, origin, shear)
    flat_c = flat_corner(v2, origin, shear)
    around = edge_side(flat_a, flat_b) + edge_side(flat_b, flat_c) + edge_side(flat_c, flat_a)
    if not owns_edge(flat_a, flat_b, around):
        return False
    return owns_edge(flat_b, flat_c, around) and owns_edge(flat_c, flat_a, around)
