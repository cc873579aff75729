"""Where packets of rays enter boxes.

A packet is bounded by a box around the origins of its rays, which widens along each axis as its slowest and fastest
ray go. Seen from there, a box's six planes move, and each bounds the distances at which the packet can be inside by a
linear inequality. A single ray is a packet of no width.

The equations are in docs/method/ray_tracing.md#traversal.
"""

import warp as wp

from lumisplat.constants import NODE_WIDTH, TRAVERSE_MARGIN
from lumisplat.device.structs.bvh import FAR, Children, Node
from lumisplat.device.structs.packet import Slabs

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

WIDTH = wp.constant(NODE_WIDTH)
MARGIN = wp.constant(wp.float32(TRAVERSE_MARGIN))
SLOPE_MIN = wp.constant(wp.float32(1.0e-9))


@wp.func
def lesser(a: float, b: float) -> float:
    """The smaller number, without the care for NaN that keeps ``wp.min`` from vectorising."""
    return wp.where(a < b, a, b)


@wp.func
def larger(a: float, b: float) -> float:
    """The larger number; see ``lesser``."""
    return wp.where(a > b, a, b)


@wp.func
def slabs_around(low: wp.vec3, high: wp.vec3, slow: wp.vec3, fast: wp.vec3) -> Slabs:
    """The planes' factors and terms: a plane of slope s, ``s t <= b``, says t <= b / s or, for s < 0, t >= b / s.

    Args:
        low: Lower corner of a box around the origins of rays.
        high: Its upper corner.
        slow: Least components of their directions.
        fast: Largest components.
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
def enter_children(node: Node, slabs: Slabs, begin: float) -> Children:
    """No ray of the packet is inside a child's box before these distances; 2 FAR: never, or only before ``begin``.

    -FAR where some may start inside: slabs are no bound of what lies behind rays.

    The loop over the children becomes vector instructions; hence one local vector per side of the boxes.
    """
    entries = Children()
    low_x = node.low_x
    low_y = node.low_y
    low_z = node.low_z
    high_x = node.high_x
    high_y = node.high_y
    high_z = node.high_z
    for c in range(WIDTH):
        ax = high_x[c] - slabs.low[0]
        bx = slabs.high[0] - low_x[c]
        ay = high_y[c] - slabs.low[1]
        by = slabs.high[1] - low_y[c]
        az = high_z[c] - slabs.low[2]
        bz = slabs.high[2] - low_z[c]
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
        entries[c] = wp.where(lesser(far - near, far - begin) >= 0.0, entry, 2.0 * FAR)
    return entries


@wp.func
def mean_entries(node: Node, slabs: Slabs, entries: Children, begin: float, end: float) -> Children:
    """No mean in a child's box projects onto a ray of the packet before these distances.

    2 FAR: it is not entered before ``end``, by ``entries``, or all its means project before ``begin``.
    """
    low_x = node.low_x
    low_y = node.low_y
    low_z = node.low_z
    high_x = node.high_x
    high_y = node.high_y
    high_z = node.high_z
    for c in range(WIDTH):
        ax = low_x[c] - slabs.high[0]
        bx = high_x[c] - slabs.low[0]
        ay = low_y[c] - slabs.high[1]
        by = high_y[c] - slabs.low[1]
        az = low_z[c] - slabs.high[2]
        bz = high_z[c] - slabs.low[2]
        x = least_product(ax, bx, slabs.slow[0], slabs.fast[0])
        y = least_product(ay, by, slabs.slow[1], slabs.fast[1])
        z = least_product(az, bz, slabs.slow[2], slabs.fast[2])
        farthest = -least_product(ax, bx, -slabs.fast[0], -slabs.slow[0])
        farthest = farthest - least_product(ay, by, -slabs.fast[1], -slabs.slow[1])
        farthest = farthest - least_product(az, bz, -slabs.fast[2], -slabs.slow[2])
        margin = MARGIN * (wp.abs(x) + wp.abs(y) + wp.abs(z) + wp.abs(farthest))
        entries[c] = wp.where(lesser(end - entries[c], farthest + margin - begin) >= 0.0, x + y + z - margin, 2.0 * FAR)
    return entries


@wp.func
def least_product(a: float, b: float, c: float, d: float) -> float:
    """The least product of a number between ``a`` and ``b`` and one between ``c`` and ``d``."""
    return lesser(lesser(a * c, a * d), lesser(b * c, b * d))
