"""Texels of a deep shadow map: by direction from the light or, for parallel light, by position in a plane across it.

The atlas holds the texels of one light: a square image, or the six faces of a cubemap.
"""

import warp as wp

from lumisplat.constants import SHADOW_TILE
from lumisplat.device.structs import struct

OCTAHEDRAL: int = wp.constant(0)

CUBEMAP: int = wp.constant(1)

PARALLEL: int = wp.constant(2)

NOTHING: int = wp.constant(0)

SOMETHING: int = wp.constant(1)

EVERYTHING: int = wp.constant(2)


@struct
class Atlas:
    """Layout of a deep shadow map: a light, its texels, and bins of distance from the light.

    The atlas has one face, or six for a cubemap, of ``size`` by ``size`` texels. Texels are numbered tile by tile.
    """

    layout: int
    """How texels map to rays from the light: OCTAHEDRAL or CUBEMAP for a point light, or PARALLEL."""
    size: int
    """Number of texels along each side of a face, a multiple of ``TILE``."""
    origin: wp.vec3
    """World-space position of a point light; for parallel light, the outer corner of texel (0, 0)."""
    axes: wp.mat33
    """Parallel light: rotation to world space; its columns are the texels' x and y axes and the travel direction."""
    texel_length: float
    """Parallel light: side of a texel in the plane across the light, scene units."""
    bins: int
    bin_length: float
    """Length of each distance bin along a ray from the light, scene units."""


@struct
class AtlasPoint:
    """Face, texel position and distance from the light of a point in a deep shadow map."""

    face: int
    x: float
    """Column on the face, in texels, as a fraction; texel centres are whole numbers."""
    y: float
    distance: float
    """Distance of the point from the light along its ray, scene units."""


@struct
class LightRay:
    """Ray from the light through a position of a deep shadow map."""

    origin: wp.vec3
    direction: wp.vec3
    """Unit direction from the light, world space."""


TILE: int = wp.constant(SHADOW_TILE)

TILE_TEXELS: int = wp.constant(SHADOW_TILE * SHADOW_TILE)


@wp.func
def parallel_direction(atlas: Atlas) -> wp.vec3:
    """Returns the unit direction in which parallel light travels, world space."""
    return wp.vec3(atlas.axes[0, 2], atlas.axes[1, 2], atlas.axes[2, 2])


@wp.func
def sign_of(value: float) -> float:
    """Returns -1 for a negative value, else 1, also for 0."""
    return wp.where(value < 0.0, -1.0, 1.0)


@wp.func
def octahedral_from_direction(direction: wp.vec3) -> wp.vec2:
    """Maps a direction to octahedral coordinates, -1..1 each (docs/method/deep_shadow_maps.md#octahedral)."""
    q = direction / (wp.abs(direction[0]) + wp.abs(direction[1]) + wp.abs(direction[2]))
    if q[2] >= 0.0:
        return wp.vec2(q[0], q[1])
    return wp.vec2(sign_of(q[0]) * (1.0 - wp.abs(q[1])), sign_of(q[1]) * (1.0 - wp.abs(q[0])))


@wp.func
def direction_from_octahedral(at: wp.vec2) -> wp.vec3:
    """Returns the unit direction at coordinates of the octahedral map, -1..1 each."""
    z = 1.0 - wp.abs(at[0]) - wp.abs(at[1])
    if z >= 0.0:
        return wp.normalize(wp.vec3(at[0], at[1], z))
    x = sign_of(at[0]) * (1.0 - wp.abs(at[1]))
    y = sign_of(at[1]) * (1.0 - wp.abs(at[0]))
    return wp.normalize(wp.vec3(x, y, z))


@wp.func
def direction_from_cube(face: int, at: wp.vec2) -> wp.vec3:
    """Returns the unit direction at coordinates of a cube face: faces 0 to 2 are towards +x, +y, +z, 3 to 5 opposite.

    The coordinates are along the two axes that follow the face's own axis in cyclic order, -1..1 each.
    """
    axis = face % 3
    direction = wp.vec3(0.0)
    direction[axis] = wp.where(face < 3, 1.0, -1.0)
    direction[(axis + 1) % 3] = at[0]
    direction[(axis + 2) % 3] = at[1]
    return wp.normalize(direction)


@wp.func
def texels_from_unit(atlas: Atlas, at: wp.vec2) -> wp.vec2:
    """Converts coordinates on a face, -1..1 each, to texels, whose centres are whole numbers."""
    half = 0.5 * float(atlas.size)
    return wp.vec2((at[0] + 1.0) * half - 0.5, (at[1] + 1.0) * half - 0.5)


@wp.func
def unit_from_texels(atlas: Atlas, x: float, y: float) -> wp.vec2:
    """Converts a position in texels, whose centres are whole numbers, to coordinates on a face, -1..1 each."""
    scale = 2.0 / float(atlas.size)
    return wp.vec2((x + 0.5) * scale - 1.0, (y + 0.5) * scale - 1.0)


@wp.func
def atlas_from_direction(atlas: Atlas, direction: wp.vec3) -> AtlasPoint:
    """Returns the face and texel position that a direction from a point light passes; the distance is set to 0.

    The direction may have any length.
    """
    position = AtlasPoint()
    if atlas.layout == OCTAHEDRAL:
        at = texels_from_unit(atlas, octahedral_from_direction(direction))
    else:
        size = wp.vec3(wp.abs(direction[0]), wp.abs(direction[1]), wp.abs(direction[2]))
        axis = int(0)
        if size[1] > size[axis]:
            axis = 1
        if size[2] > size[axis]:
            axis = 2
        position.face = wp.where(direction[axis] < 0.0, axis + 3, axis)
        along = wp.vec2(direction[(axis + 1) % 3], direction[(axis + 2) % 3]) / size[axis]
        at = texels_from_unit(atlas, along)
    position.x = at[0]
    position.y = at[1]
    return position


@wp.func
def atlas_from_world(atlas: Atlas, point: wp.vec3) -> AtlasPoint:
    """Returns the face, texel position and distance from the light of a world-space point.

    At the light's own position, the distance is 0 and the direction arbitrary.
    """
    offset = point - atlas.origin
    if atlas.layout == PARALLEL:
        local = wp.transpose(atlas.axes) * offset
        position = AtlasPoint()
        position.x = local[0] / atlas.texel_length - 0.5
        position.y = local[1] / atlas.texel_length - 0.5
        position.distance = local[2]
        return position
    distance = wp.length(offset)
    if distance == 0.0:
        offset = wp.vec3(0.0, 0.0, 1.0)
    position = atlas_from_direction(atlas, offset)
    position.distance = distance
    return position


@wp.func
def ray_through(atlas: Atlas, face: int, x: float, y: float) -> LightRay:
    """Returns the ray from the light through position (x, y), in texels, of face ``face``."""
    ray = LightRay()
    if atlas.layout == PARALLEL:
        ray.origin = atlas.origin + atlas.axes * wp.vec3(
            (x + 0.5) * atlas.texel_length, (y + 0.5) * atlas.texel_length, 0.0
        )
        ray.direction = parallel_direction(atlas)
        return ray
    ray.origin = atlas.origin
    if atlas.layout == OCTAHEDRAL:
        ray.direction = direction_from_octahedral(unit_from_texels(atlas, x, y))
    else:
        ray.direction = direction_from_cube(face, unit_from_texels(atlas, x, y))
    return ray


@wp.func
def texel_number(atlas: Atlas, face: int, x: int, y: int) -> int:
    """Returns the index of texel (x, y) of a face; one step beyond an edge, the neighbouring texel on the sphere.

    -1: outside the plane of parallel light, where there is no neighbour.
    """
    size = atlas.size
    if x < 0 or y < 0 or x >= size or y >= size:
        if atlas.layout == PARALLEL:
            return -1
        if atlas.layout == OCTAHEDRAL:
            # An edge is folded at its centre, so that its halves coincide: beyond it lies its own mirror image.
            if x < 0 or x >= size:
                x = wp.where(x < 0, -1 - x, 2 * size - 1 - x)
                y = size - 1 - y
            if y < 0 or y >= size:
                y = wp.where(y < 0, -1 - y, 2 * size - 1 - y)
                x = size - 1 - x
        else:
            beyond = direction_from_cube(face, unit_from_texels(atlas, float(x), float(y)))
            position = atlas_from_direction(atlas, beyond)
            face = position.face
            x = wp.clamp(int(wp.floor(position.x + 0.5)), 0, size - 1)
            y = wp.clamp(int(wp.floor(position.y + 0.5)), 0, size - 1)
    tiles = size // TILE
    return ((face * tiles + y // TILE) * tiles + x // TILE) * TILE_TEXELS + (y % TILE) * TILE + x % TILE


@wp.func
def texel_coordinates(atlas: Atlas, texel: int) -> wp.vec3i:
    """Returns the face, column x and row y of the texel with index ``texel``."""
    tiles = atlas.size // TILE
    tile = texel // TILE_TEXELS
    within = texel % TILE_TEXELS
    x = (tile % tiles) * TILE + within % TILE
    y = ((tile // tiles) % tiles) * TILE + within // TILE
    return wp.vec3i(tile // (tiles * tiles), x, y)
