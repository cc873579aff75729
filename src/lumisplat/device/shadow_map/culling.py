"""Culling of casters (Gaussians that block light) for the cells (squares of texels) of a deep shadow map.

A caster is kept for a cell if the bounds of the two intersect (docs/method/deep_shadow_maps.md#culling).
"""

import warp as wp

from lumisplat.constants import SHADOW_BOUND_MARGIN
from lumisplat.device.math.directions import around
from lumisplat.device.shadow_map.atlas import EVERYTHING, PARALLEL, SOMETHING, Atlas, parallel_direction, ray_through
from lumisplat.device.shadow_map.optical_depth import Casters, reach_squared_of
from lumisplat.device.structs import struct

SHADOW_BOUND_STEP = 4
"""The cone around a cell's rays is computed from points on the cell's edges at this distance, in texels.

The edges of the atlas fold at multiples of this distance, because the sizes of atlases are multiples of 8."""


@struct
class Footprint:
    """Bounds of the light rays on which a caster, a Gaussian that blocks light, has noticeable optical depth.

    They are a cone, and a rectangle in a plane: for a point light, the plane that touches the unit sphere in the
    caster's direction (gnomonic projection); for parallel light, the plane across the light.
    """

    extent: int
    """NOTHING: the caster darkens no ray. SOMETHING: only rays within the bounds. EVERYTHING: any ray may be darkened.
    """
    direction: wp.vec3
    """Unit direction from the light to the caster; for parallel light, the direction in which the light travels."""
    cosine: float
    """Cosine of the half angle of the cone from a point light around the caster."""
    sine: float
    first: wp.vec3
    """Unit axis of the rectangle along the longer axis of the caster's shadow, world space."""
    second: wp.vec3
    low: wp.vec2
    """Lower bounds of the rectangle along its two axes, ``first`` and ``second``."""
    high: wp.vec2
    """Upper bounds of the rectangle along its two axes, ``first`` and ``second``."""


@struct
class Cell:
    """A square of texels, with a cone around the rays through it or, for parallel light, a cylinder."""

    axis: wp.vec3
    """Point light: unit axis of the cone. Parallel light: centre of the square relative to ``Atlas.origin``."""
    cosine: float
    """Point light: cosine of the cone's half angle; below 0, the cone exceeds a half space and bounds nothing."""
    sine: float
    """Point light: sine of the cone's half angle. Parallel light: radius of the cylinder, scene units."""
    parent: int
    """Index in CasterLists of the list of a larger cell around this one; only casters of that list are tested against
    this cell."""


@struct
class CasterLists:
    """Lists of casters (Gaussians that block light), one for each cell of texels, in one array."""

    ends: wp.array[int]
    """Index in ``items`` after the last caster of each list; the next list begins there."""
    items: wp.array[int]
    """Indices of casters, list by list, ascending within each list."""


STEP: int = wp.constant(SHADOW_BOUND_STEP)

MARGIN = wp.constant(wp.float32(SHADOW_BOUND_MARGIN))


@wp.func
def longer_axis(ellipsoid: wp.mat33, direction: wp.vec3) -> wp.vec3:
    """Returns the longer axis, a unit vector, of the shadow of an ellipsoid on a plane orthogonal to ``direction``.

    The light is parallel to ``direction``. The columns of ``ellipsoid`` are the semi-axes.
    """
    u = around(direction, 0.0, 1.0, 0.0)
    v = wp.cross(direction, u)
    along_u = wp.transpose(ellipsoid) * u
    along_v = wp.transpose(ellipsoid) * v
    turn = 0.5 * wp.atan2(2.0 * wp.dot(along_u, along_v), wp.dot(along_u, along_u) - wp.dot(along_v, along_v))
    return wp.cos(turn) * u + wp.sin(turn) * v


@wp.func
def footprint_of(atlas: Atlas, casters: Casters, i: int, absorption: float) -> Footprint:
    """Returns the bounds of the rays from the light that caster ``i`` darkens more than negligibly.

    They bound an ellipsoid beyond which the caster's optical depth is negligible. The rectangle lies along the axes of
    the ellipsoid's shadow, and bounds its perspective image exactly, by its dual quadric
    (docs/method/deep_shadow_maps.md#footprint). ``absorption`` is that at the caster's mean, per scene unit.
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
    """Returns point ``k``, in texels, on the perimeter of a square of side ``side``, in steps of ``STEP`` texels."""
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
    """Returns the cell of ``side`` x ``side`` texels from ``corner`` on, with the cone or cylinder around its rays.

    ``corner`` is the face, x and y of the first texel; ``side`` is a multiple of ``STEP``. The cone contains points on
    the edges. Between two such points, an edge that does not fold is an arc of a great circle. The whole arc is nearer
    to the cone's axis than the farther of the two points, so that the cone contains the whole edge.
    """
    cell = Cell()
    cell.parent = parent
    x = float(corner[1]) - 0.5
    y = float(corner[2]) - 0.5
    # The last cells of a face may extend beyond it, where an octahedral map folds back, so they are cut at its edge.
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
    """Returns whether a cone's image in the plane at distance 1 overlaps the strip between two lines of the plane.

    The lines are orthogonal to one axis of the plane, with coordinates ``low`` and ``high`` along it. ``axis_cosine``
    is the cosine of the angle between the cone's axis and that axis of the plane, ``forward`` the cosine of the angle
    between the cone's axis and the plane's normal. ``forward`` exceeds ``sine``, the sine of the cone's half angle.
    """
    behind = forward * forward - sine * sine
    middle = axis_cosine * forward / behind
    width = sine * wp.sqrt(wp.max(axis_cosine * axis_cosine + behind, 0.0)) / behind
    return middle - width <= high and middle + width >= low


@wp.func
def may_intersect(atlas: Atlas, footprint: Footprint, cell: Cell) -> bool:
    """Returns whether rays through a cell may be darkened by the caster with bounds ``footprint``.

    The test is conservative: it never returns False for such a ray.
    """
    if footprint.extent != SOMETHING:
        return footprint.extent == EVERYTHING
    forward = wp.dot(cell.axis, footprint.direction)
    # Rejects pairs whose axes form a larger angle than the sum of the half angles; cosines make this test fast.
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
    """Returns the index in ``CasterLists.items`` of the first caster of list ``i``."""
    return wp.where(i > 0, lists.ends[wp.max(i - 1, 0)], 0)


@wp.func
def part_of_list(lists: CasterLists, i: int, part: int, parts: int):
    """Returns begin and end, in ``CasterLists.items``, of part ``part`` of list ``i``, divided into ``parts`` parts."""
    begin = list_begin(lists, i)
    end = lists.ends[i]
    size = (end - begin + parts - 1) // parts
    return wp.min(begin + part * size, end), wp.min(begin + (part + 1) * size, end)
