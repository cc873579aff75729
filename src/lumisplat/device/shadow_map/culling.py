"""Bounds of casters and of cells of an atlas, and which intersect (docs/method/deep_shadow_maps.md#culling)."""

import warp as wp

from lumisplat.constants import SHADOW_BOUND_MARGIN
from lumisplat.device.math.directions import around
from lumisplat.device.shadow_map.atlas import EVERYTHING, PARALLEL, SOMETHING, Atlas, parallel_direction, ray_through
from lumisplat.device.shadow_map.optical_depth import Casters, reach_squared_of
from lumisplat.device.structs import struct

SHADOW_BOUND_STEP = 4
"""Texels between the points that bound a tile: atlas edges fold at multiples of it, as sizes are multiples of 8."""


@struct
class Footprint:
    """The part of an atlas where an occluder's optical depth is not negligible.

    For a point light, in the plane that touches the unit sphere in its direction (the gnomonic projection); for
    parallel light, in the plane across the light.
    """

    extent: int
    """NOTHING: no part. SOMETHING: the part below. EVERYTHING: all of it."""
    direction: wp.vec3
    """From the light, unit."""
    cosine: float
    """Of the angle between it and the circular cone around the caster."""
    sine: float
    first: wp.vec3
    """An axis of the plane: the longer one of the occluder's shadow."""
    second: wp.vec3
    low: wp.vec2
    """Where it begins along the two axes."""
    high: wp.vec2
    """Where it ends."""


@struct
class Cell:
    """A square of texels, and a bound of the rays through it: a cone, or for parallel light a cylinder."""

    axis: wp.vec3
    """Unit, to the middle of the cone; of parallel light, the middle itself, from the light's origin."""
    cosine: float
    """Of half the cone's angle; below 0 the cone is wider than a half space and bounds nothing."""
    sine: float
    """Of half the cone's angle; of parallel light, the cylinder's radius, scene units."""
    parent: int
    """Number of the list, among those given for culling, whose casters may intersect this cell."""


@struct
class CasterLists:
    """Lists of casters, one after another."""

    ends: wp.array[int]
    """Where each list ends and the next one begins."""
    items: wp.array[int]
    """Numbers of casters, ascending in each list."""


STEP: int = wp.constant(SHADOW_BOUND_STEP)

MARGIN = wp.constant(wp.float32(SHADOW_BOUND_MARGIN))


@wp.func
def longer_axis(ellipsoid: wp.mat33, direction: wp.vec3) -> wp.vec3:
    """The longer axis of an ellipsoid's shadow across a direction, unit; columns of ``ellipsoid`` are its semi-axes."""
    u = around(direction, 0.0, 1.0, 0.0)
    v = wp.cross(direction, u)
    along_u = wp.transpose(ellipsoid) * u
    along_v = wp.transpose(ellipsoid) * v
    turn = 0.5 * wp.atan2(2.0 * wp.dot(along_u, along_v), wp.dot(along_u, along_u) - wp.dot(along_v, along_v))
    return wp.cos(turn) * u + wp.sin(turn) * v


@wp.func
def footprint_of(atlas: Atlas, casters: Casters, i: int, absorption: float) -> Footprint:
    """What caster ``i`` covers: the ellipsoid outside which lines have negligible depth in it, seen from the light.

    The rectangle lies along the axes of the covariance across the light, and bounds the ellipsoid's perspective image
    exactly, by its dual quadric (docs/method/deep_shadow_maps.md#footprint).
    """
    footprint = Footprint()
    scale = casters.scales[i]
    reach2 = reach_squared_of(absorption, scale)
    if reach2 <= 0.0:
        return footprint
    footprint.extent = EVERYTHING
    offset = casters.means[i] - atlas.origin
    distance = wp.length(offset)
    reach = wp.sqrt(reach2) * wp.max(scale)
    direction = parallel_direction(atlas)
    if atlas.layout != PARALLEL:
        if distance <= reach * (1.0 + MARGIN):
            return footprint
        direction = offset / distance
    footprint.extent = SOMETHING
    footprint.direction = direction

    ellipsoid = wp.sqrt(reach2) * (wp.quat_to_matrix(casters.rotations[i]) * wp.diag(scale))
    footprint.first = longer_axis(ellipsoid, direction)
    footprint.second = wp.cross(direction, footprint.first)
    first = wp.transpose(ellipsoid) * footprint.first
    second = wp.transpose(ellipsoid) * footprint.second
    half = wp.vec2(wp.length(first), wp.length(second)) * (1.0 + MARGIN)
    if atlas.layout == PARALLEL:
        middle = wp.vec2(wp.dot(offset, footprint.first), wp.dot(offset, footprint.second))
        margin = wp.vec2(MARGIN * atlas.texel_length)
        footprint.low = middle - half - margin
        footprint.high = middle + half + margin
        return footprint
    angle = wp.asin(reach / distance) + MARGIN
    footprint.cosine = wp.cos(angle)
    footprint.sine = wp.sin(angle)
    depth = wp.transpose(ellipsoid) * direction
    behind = distance * distance - wp.dot(depth, depth)
    skew = wp.vec2(wp.dot(first, depth), wp.dot(second, depth)) / behind
    width = wp.vec2(
        wp.sqrt(skew[0] * skew[0] + half[0] * half[0] / behind) + MARGIN * angle,
        wp.sqrt(skew[1] * skew[1] + half[1] * half[1] / behind) + MARGIN * angle,
    )
    footprint.low = -skew - width
    footprint.high = -skew + width
    return footprint


@wp.func
def perimeter_point(k: int, side: int) -> wp.vec2:
    """Point ``k`` on the perimeter of a square of ``side`` texels, ``STEP`` from the one before."""
    steps = side // STEP
    along = float((k % steps) * STEP)
    edge = k // steps
    if edge == 0:
        return wp.vec2(along, 0.0)
    if edge == 1:
        return wp.vec2(float(side), along)
    if edge == 2:
        return wp.vec2(float(side) - along, float(side))
    return wp.vec2(0.0, float(side) - along)


@wp.func
def bounded_cell(atlas: Atlas, corner: wp.vec3i, side: int, parent: int) -> Cell:
    """The cell of a square of ``side`` texels, bounded by points of its edges.

    Between two points of an edge that does not fold lies a great circle, which is nearer to the cone's axis than one of
    the points.

    ``corner`` has face, x and y of its first texel; ``side`` is a multiple of ``STEP``.
    """
    cell = Cell()
    cell.parent = parent
    x = float(corner[1]) - 0.5
    y = float(corner[2]) - 0.5
    # The last cells of a face may reach beyond it, where an octahedral map folds back: they end with it.
    width = wp.min(float(side), float(atlas.size - corner[1]))
    height = wp.min(float(side), float(atlas.size - corner[2]))
    middle = ray_through(atlas, corner[0], x + 0.5 * width, y + 0.5 * height)
    if atlas.layout == PARALLEL:
        cell.axis = middle.origin - atlas.origin
        cell.sine = 0.70710678 * float(side) * atlas.texel_length * (1.0 + MARGIN)
        return cell
    farthest = float(0.0)
    for k in range(4 * (side // STEP)):
        point = perimeter_point(k, side)
        edge = ray_through(atlas, corner[0], x + wp.min(point[0], width), y + wp.min(point[1], height))
        farthest = wp.max(farthest, wp.length(edge.direction - middle.direction))
    cell.axis = middle.direction
    angle = 2.0 * wp.asin(wp.min(0.5 * farthest, 1.0)) * (1.0 + MARGIN) + MARGIN
    cell.cosine = wp.cos(angle)
    cell.sine = wp.sin(angle)
    return cell


@wp.func
def overlaps(axis_cosine: float, forward: float, sine: float, low: float, high: float) -> bool:
    """Whether a cone's image in the plane at distance 1 reaches between two lines across one of the plane's axes.

    ``axis_cosine`` is that of the cone's axis with that axis of the plane, ``forward`` that with the plane's normal,
    above ``sine``, which is that of half the cone's angle; ``low`` and ``high`` are coordinates of the lines.
    """
    behind = forward * forward - sine * sine
    middle = axis_cosine * forward / behind
    width = sine * wp.sqrt(wp.max(axis_cosine * axis_cosine + behind, 0.0)) / behind
    return middle - width <= high and middle + width >= low


@wp.func
def may_intersect(atlas: Atlas, footprint: Footprint, cell: Cell) -> bool:
    """Whether rays through a cell may have more than negligible depth in a caster: never wrongly False."""
    if footprint.extent != SOMETHING:
        return footprint.extent == EVERYTHING
    forward = wp.dot(cell.axis, footprint.direction)
    # False if the axes are farther apart than the two half angles together; by cosines, as most pairs end here.
    if atlas.layout != PARALLEL and (
        cell.cosine >= 0.0 and forward < cell.cosine * footprint.cosine - cell.sine * footprint.sine
    ):
        return False
    across = wp.dot(cell.axis, footprint.first)
    down = wp.dot(cell.axis, footprint.second)
    if atlas.layout == PARALLEL:
        r = cell.sine
        low = footprint.low
        high = footprint.high
        return across - r <= high[0] and across + r >= low[0] and down - r <= high[1] and down + r >= low[1]
    if cell.cosine < 0.0 or forward <= cell.sine:
        return True
    return overlaps(across, forward, cell.sine, footprint.low[0], footprint.high[0]) and overlaps(
        down, forward, cell.sine, footprint.low[1], footprint.high[1]
    )


@wp.func
def list_begin(lists: CasterLists, i: int) -> int:
    """Where list ``i`` begins."""
    return wp.where(i > 0, lists.ends[wp.max(i - 1, 0)], 0)


@wp.func
def part_of_list(lists: CasterLists, i: int, part: int, parts: int):
    """Where a part of list ``i`` begins, and where it ends."""
    begin = list_begin(lists, i)
    end = lists.ends[i]
    size = (end - begin + parts - 1) // parts
    return wp.min(begin + part * size, end), wp.min(begin + (part + 1) * size, end)
