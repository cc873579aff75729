"""World-space radiance cache: its data, the cell of a hit, and lookup of the stored radiance.

Surfaces are assigned to one of six faces by their normals, as on a cube. Cells are squares in the plane of a face, as
thick as they are wide; 8 x 8 cells form a tile. Each tile stores 85 means: of its cells in row order, then of squares
of 2 x 2, 4 x 4 and 8 x 8 cells. See docs/method/realtime.md#radiance-cache.
"""

import warp as wp

from lumisplat.device.math.random import mix
from lumisplat.device.math.sorting import first_not_below
from lumisplat.device.structs import struct

LAYER_SHIFT = 0.382
"""Offset, in cells, of the planes between layers of cells along a face's axis.

Walls often lie at whole numbers, halves or quarters, where rounding would put their points into two layers."""

TILE_CELLS: int = wp.constant(64)
"""Number of cells of a cache tile, 8 x 8."""

TILE_MEANS: int = wp.constant(85)
"""Number of means that a cache tile stores: 64 cells, and 16 + 4 + 1 squares of cells."""

TILE_MIPS: int = wp.constant(4)
"""Number of mip levels of a cache tile: means over squares 1, 2, 4 and 8 cells wide."""

NO_TILE: wp.int64 = wp.constant(wp.int64(2**63 - 1))
"""Tile key of samples that belong to no cache tile; larger than all other keys."""

LEVEL_LAST: int = wp.constant(16)
"""Cells of level n are 2^n scene units wide, with -LEVEL_LAST <= n < LEVEL_LAST; n takes 5 bits of the key."""

NEAR_LEVELS: int = wp.constant(3)
"""Cells of short rays are 2^NEAR_LEVELS times narrower: their tile is as wide as one cell of long rays."""

COORDINATE_BITS: int = wp.constant(18)
"""Number of bits of a tile's key for each of its three coordinates."""

CELLS_REACH: float = wp.constant(8191.0)
"""Before rounding, a cell is at least as wide as its distance from the origin, along any axis, divided by this number.

Widths are then rounded down to a power of two, and cells of short rays are eight times narrower; the coordinates of all
cells fit the key.
"""

REFLECTANCE_MAX: float = wp.constant(0.99)
"""The albedo by which surfaces reflect cached light is limited to this, so that light between white walls converges."""

AGE_LAST: int = wp.constant(2**31 - 1)
"""Frame number of unused tiles when tiles are sorted by age; larger than all frame numbers."""

COUNT_LIVE: int = wp.constant(0)
"""Index in ``CacheTiles.counts`` of the number of tiles that the cache holds."""

COUNT_NEW: int = wp.constant(1)
"""Index in ``CacheTiles.counts`` of the number of tiles that an insertion adds."""

COUNT_EXCESS: int = wp.constant(2)
"""Index in ``CacheTiles.counts`` of the number of tiles that an insertion would add beyond the capacity."""

COUNT_EVICTED: int = wp.constant(3)
"""Index in ``CacheTiles.counts`` of the number of tiles evicted early since the start, to make space for new ones."""

COUNT_DROPPED: int = wp.constant(4)
"""Index in ``CacheTiles.counts`` of the number of new tiles dropped since the start, because the cache was full."""

COUNTS: int = wp.constant(5)
"""Length of the array of tile counts, ``CacheTiles.counts``."""


@struct
class CacheSamples:
    """Surface points that rays hit, to be added to the radiance cache or looked up in it; one element for each ray."""

    is_active: wp.array[bool]
    """False: the ray hit nothing, and the other fields are undefined."""
    position: wp.array[wp.vec3]
    """Hit position, world space."""
    normal: wp.array[wp.vec3]
    """Surface normal, unit, towards the ray's origin, world space."""
    direction: wp.array[wp.vec3]
    """Direction of the ray, unit, world space."""
    distance: wp.array[float]
    """Length of the ray from its origin to the hit, scene units."""
    from_eye: wp.array[float]
    """Distance of the hit from the eye, scene units; cells grow with it."""
    albedo: wp.array[wp.vec3]
    """Diffuse albedo of the hit surface, linear."""
    radiance: wp.array[wp.vec3]
    """Linear radiance that the hit surface reflects of direct light from lights and environment, without emission."""
    light: wp.array[int]
    """Index of the light that ``radiance`` is a sample of; -1: of no light."""
    arrived: wp.array[float]
    """Fraction of that light's sample that arrived, 0..1."""
    extent: wp.array[float]
    """Position uncertainty of the surface, scene units: the largest scale of its Gaussian; 0 for meshes."""


@struct
class CachePoints:
    """Surface points of cache cells; rays from them gather indirect light. One element for each ray.

    The points of one cell are adjacent in the arrays, and so are the points of one tile.
    """

    is_active: wp.array[bool]
    """False: the element has no ray, and its other fields are undefined."""
    position: wp.array[wp.vec3]
    """Position of the point, world space."""
    normal: wp.array[wp.vec3]
    """Surface normal at the point, unit, world space."""
    extent: wp.array[float]
    """Largest scale of the Gaussian on which the point lies, scene units: its position uncertainty; 0 for meshes."""
    key: wp.array[wp.uint32]
    """Random key of the rays of the point's cell, from the cell's tile key and the frame number.

    It does not depend on where the tile's data are stored."""
    ray: wp.array[int]
    """Index, from 0, of this ray among the rays of the same cell."""
    rays: wp.array[int]
    """Number of rays that the point's cell sends in this frame."""
    slot: wp.array[int]
    """Index, in the arrays of CacheTiles, of the tile that the point's cell belongs to; -1: no ray."""
    cell: wp.array[int]
    """Index of the point's cell among the 8 x 8 cells of its tile, in row order."""


@struct
class CacheGrid:
    """Settings of the radiance cache, as kernels need them."""

    cell_size: float
    """Largest width of a cell as a fraction of its distance from the eye."""
    history: float
    """Number of frames after which the mean of a cell's direct light becomes a moving average."""
    bounce_history: float
    """Number of rays after which the mean of a cell's indirect light becomes a moving average."""
    samples_min: float
    """A mean of fewer samples counts as noisy, so that lookups use a mean over a larger square instead."""
    tiles: int
    """Largest number of tiles that the cache holds."""


@struct
class CacheTiles:
    """Tiles of 8 x 8 cells that the radiance cache holds, found by sorted keys.

    The data of a tile stay at one index, its slot. ``slots`` is a permutation of all slots: first the slots of the
    tiles in the order of ``keys``, then the free slots.
    """

    counts: wp.array[int]
    """Statistics of tiles: numbers held, added, in excess, evicted and dropped, at ``COUNT_LIVE`` to
    ``COUNT_DROPPED``."""
    keys: wp.array[wp.int64]
    """Keys of the tiles that the cache holds, ascending; unused elements hold ``NO_TILE``."""
    slots: wp.array[int]
    """Slot of each tile, in the order of ``keys``, then the free slots. A slot indexes the arrays that follow."""
    used: wp.array[int]
    """For each slot, the number of the last frame in which a ray hit its tile."""
    bounced: wp.array[int]
    """For each slot, 1 + number of the last frame in which the tile's cells sent rays for indirect light; 0: never."""
    filled: wp.array[int]
    """For each slot, the number of cells of its tile that have samples."""
    direct: wp.array[wp.vec4]
    """xyz: mean linear radiance that surfaces reflect of direct light; w: number of samples in the mean.

    Each slot has ``TILE_MEANS`` elements."""
    indirect: wp.array[wp.vec4]
    """xyz: mean linear indirect radiance arriving, cosine-weighted (irradiance over pi); w: number of rays in the
    mean.

    Each slot has ``TILE_MEANS`` elements. Arriving radiance is stored, because the surfaces of a cell may differ in
    albedo."""
    frames: wp.array[int]
    """For each cell, the number of frames that had samples in it, at most ``CacheGrid.history``; 0: empty.

    Each slot has ``TILE_CELLS`` elements."""
    arrived: wp.array[wp.uint8]
    """For each cell and each of `GRID_LIGHTS` lights, the fraction of the light's samples that arrived lately, 0..255.

    Each slot has ``TILE_CELLS * GRID_LIGHTS`` elements."""
    updated: wp.array[int]
    """For each cell, the number of the last frame that had samples in it; each slot has ``TILE_CELLS`` elements."""
    position: wp.array[wp.vec3]
    """For each cell, the world-space position of one random sample of its last frame; ``TILE_CELLS`` elements per
    slot.

    Rays for indirect light start there."""
    normal: wp.array[wp.vec3]
    """For each cell, the unit surface normal of the sample at ``position``, world space."""
    extent: wp.array[float]
    """For each cell, the largest scale of the Gaussian of the sample at ``position``, scene units; 0 for meshes."""


@struct
class SortedSamples:
    """Order of a frame's cache samples, sorted by tile, then by cell, then by index."""

    keys: wp.array[wp.int64]
    """Tile keys of the samples in ascending order; ``NO_TILE`` for samples that belong to no tile.

    The second half of the array is scratch space for the sort."""
    order: wp.array[int]
    """Indices of the samples in sorted order; the second half of the array is scratch space for the sort."""
    cells: wp.array[int]
    """For each sample, unsorted, the index of its cell among the 8 x 8 cells of its tile."""


SHIFT = wp.constant(wp.float32(LAYER_SHIFT))

COORDINATE_MASK = wp.constant(2**18 - 1)

BITS_32 = wp.constant(wp.int64(32))

KEY_ORIGIN = wp.constant(wp.uint32(0x63616368))
"""Initial state of the hash that makes the random keys of cache cells; they differ from the keys of pixels."""


@wp.struct
class CacheCell:
    """Address of a cache cell: key of its tile, and its index in the tile."""

    key: wp.int64
    """Key of the cell's tile; ``NO_TILE``: the sample lies too far out or is not finite."""
    cell: int
    """Index of the cell among the 8 x 8 cells of its tile, in row order."""


@wp.struct
class CellLight:
    """Linear radiance that leaves a hit surface according to the cache, split into direct and indirect light."""

    direct: wp.vec3
    """Linear radiance that the surface reflects of direct light from lights and environment."""
    indirect: wp.vec3
    """Linear radiance that the surface reflects of light from other surfaces."""
    is_valid: bool
    """True if ``indirect`` comes from at least one ray; false: no ray has sampled it, and it is 0."""


@wp.func
def exponent_of(value: float) -> int:
    """Returns floor(log2(value)) of a positive number, exactly and with the same result on every device."""
    return ((wp.cast(value, wp.int32) >> 23) & 255) - 127


@wp.func
def width_of(level: int) -> float:
    """Returns the cell width of a level, 2^level scene units."""
    return wp.cast((level + 127) << 23, wp.float32)


@wp.func
def level_of(grid: CacheGrid, position: wp.vec3, from_eye: float) -> int:
    """Returns n such that cells for long rays at a position are 2^n scene units wide; it grows with ``from_eye``."""
    reach = wp.max(wp.abs(position))
    width = wp.max(grid.cell_size * from_eye, reach / CELLS_REACH)
    # The next coarser and finer levels and the levels of short rays must exist, too.
    return wp.clamp(exponent_of(width), NEAR_LEVELS - LEVEL_LAST, LEVEL_LAST - 2)


@wp.func
def face_of(normal: wp.vec3) -> int:
    """Returns which of six axis directions a normal is closest to: 0 +x, 1 -x, 2 +y, 3 -y, 4 +z, 5 -z."""
    axis = int(2)
    if wp.abs(normal[0]) >= wp.abs(normal[1]) and wp.abs(normal[0]) >= wp.abs(normal[2]):
        axis = 0
    elif wp.abs(normal[1]) >= wp.abs(normal[2]):
        axis = 1
    return 2 * axis + int(normal[axis] < 0.0)


@wp.func
def with_coordinate(key: wp.int64, coordinate: int) -> wp.int64:
    """Shifts a key to the left and puts the bits of a tile coordinate into its low bits."""
    return (key << wp.int64(COORDINATE_BITS)) | wp.int64(coordinate & COORDINATE_MASK)


@wp.func
def cell_at(position: wp.vec3, normal: wp.vec3, level: int, for_short: bool) -> CacheCell:
    """Returns the cache cell, 2^level scene units wide, that contains a surface point with a normal.

    ``for_short`` selects the cells for short rays instead of those for long rays.
    """
    cell = CacheCell()
    cell.key = NO_TILE
    scaled = position / width_of(level)
    # Also false for infinities and NaN.
    if wp.max(wp.abs(scaled)) < float(COORDINATE_MASK // 2) and wp.isfinite(normal):
        face = face_of(normal)
        axis = face // 2
        u = int(wp.floor(scaled[(axis + 1) % 3]))
        v = int(wp.floor(scaled[(axis + 2) % 3]))
        w = int(wp.floor(scaled[axis] + SHIFT))
        head = wp.int64(2 * (8 * (level + LEVEL_LAST) + face) + int(for_short))
        cell.key = with_coordinate(with_coordinate(with_coordinate(head, u >> 3), v >> 3), w)
        cell.cell = 8 * (v & 7) + (u & 7)
    return cell


@wp.func
def is_of_short_rays(key: wp.int64) -> bool:
    """Returns whether the tile with this key has cells for short rays, by the bit before the three coordinates."""
    return ((key >> wp.int64(3 * COORDINATE_BITS)) & wp.int64(1)) != wp.int64(0)


@wp.func
def is_near(samples: CacheSamples, i: int, level: int) -> bool:
    """Returns whether ray ``i`` is short: its length is below the width of a cell of this level.

    The ray's origin may then lie on the other side of a wall from the rest of the cell.
    """
    return samples.distance[i] < width_of(level) + samples.extent[i]


@wp.func
def cell_of_sample(grid: CacheGrid, samples: CacheSamples, i: int) -> CacheCell:
    """Returns the cache cell that the direct light of sample ``i`` is added to: a finer one for a short ray."""
    level = level_of(grid, samples.position[i], samples.from_eye[i])
    near = is_near(samples, i, level)
    if near:
        level -= NEAR_LEVELS
    return cell_at(samples.position[i], samples.normal[i], level, near)


@wp.func
def slot_of(tiles: CacheTiles, key: wp.int64) -> int:
    """Returns the slot (index of the stored data) of the tile with this key; -1: the cache has no such tile."""
    live = tiles.counts[COUNT_LIVE]
    rank = first_not_below(tiles.keys, live, key)
    if rank < live:
        if tiles.keys[rank] == key:
            return tiles.slots[rank]
    return -1


@wp.func
def mean_index(slot: int, cell: int, mip: int) -> int:
    """Returns the index, in the means of ``slot``, of the mean over the 2^mip x 2^mip cells that contain ``cell``."""
    side = 8 >> mip
    before = (4 * (TILE_CELLS - side * side)) // 3
    return slot * TILE_MEANS + before + ((cell >> 3) >> mip) * side + ((cell & 7) >> mip)


@wp.func
def reliable_mean(means: wp.array[wp.vec4], slot: int, cell: int, samples_min: float, best: wp.vec4) -> wp.vec4:
    """Returns the mean over the smallest square around a cell that has at least ``samples_min`` samples.

    ``best`` is a mean found earlier, returned if it has that many samples. If no mean has, the mean with the most
    samples is returned.
    """
    if best[3] >= samples_min or slot < 0:
        return best
    for mip in range(TILE_MIPS):
        mean = means[mean_index(slot, cell, mip)]
        if mean[3] > best[3]:
            best = mean
        if best[3] >= samples_min:
            break
    return best


@wp.func
def color_of(mean: wp.vec4) -> wp.vec3:
    """Returns the first three components of a stored mean, its radiance; the fourth is the number of samples."""
    return wp.vec3(mean[0], mean[1], mean[2])


@wp.func
def reflected_light(samples: CacheSamples, i: int, indirect: wp.vec4) -> wp.vec3:
    """Returns the radiance that the surface of sample ``i`` reflects: its albedo times the mean ``indirect``."""
    return wp.cw_mul(wp.min(samples.albedo[i], wp.vec3(REFLECTANCE_MAX)), color_of(indirect))


@wp.func
def long_ray_radiance(
    tiles: CacheTiles, grid: CacheGrid, samples: CacheSamples, i: int, position: wp.vec3, level: int
) -> CellLight:
    """Looks up the direct and indirect light of sample ``i`` at ``position``, a point in the plane of its surface.

    If a level has too few samples, the next coarser and then the next finer level are looked up: they store values from
    before the camera moved closer or farther away.
    """
    direct = wp.vec4()
    indirect = wp.vec4()
    for step in range(3):
        if direct[3] < grid.samples_min or indirect[3] < grid.samples_min:
            # Level offsets 0, 1, -1.
            cell = cell_at(position, samples.normal[i], level + (step & 1) - (step >> 1), False)
            slot = slot_of(tiles, cell.key)
            direct = reliable_mean(tiles.direct, slot, cell.cell, grid.samples_min, direct)
            indirect = reliable_mean(tiles.indirect, slot, cell.cell, grid.samples_min, indirect)
    light = CellLight()
    light.direct = samples.radiance[i]
    if direct[3] > 0.0:
        light.direct = color_of(direct)
    light.indirect = reflected_light(samples, i, indirect)
    light.is_valid = indirect[3] > 0.0
    return light


@wp.func
def cached_radiance(tiles: CacheTiles, grid: CacheGrid, samples: CacheSamples, i: int) -> wp.vec3:
    """Returns the linear radiance leaving the surface of sample ``i``, over all bounces, without emission.

    For a short ray, the direct light is the sample's own, and the indirect light is that of the fine cells for short
    rays, because a mean over a larger cell may leak through a wall.
    """
    level = level_of(grid, samples.position[i], samples.from_eye[i])
    if is_near(samples, i, level):
        cell = cell_at(samples.position[i], samples.normal[i], level - NEAR_LEVELS, True)
        near = reliable_mean(tiles.indirect, slot_of(tiles, cell.key), cell.cell, 1.0, wp.vec4())
        if near[3] > 0.0:
            return samples.radiance[i] + reflected_light(samples, i, near)
        return samples.radiance[i] + long_ray_radiance(tiles, grid, samples, i, samples.position[i], level).indirect
    far = long_ray_radiance(tiles, grid, samples, i, samples.position[i], level)
    return far.direct + far.indirect


@wp.func
def cell_key(key: wp.int64, cell: int, frame: int) -> wp.uint32:
    """Returns the random key of cell ``cell`` of the tile with this key in frame number ``frame``."""
    low = wp.uint32(key & wp.int64(0xFFFFFFFF))
    high = wp.uint32(key >> BITS_32)
    word = mix(mix(KEY_ORIGIN + mix(low)) + mix(high))
    return mix(mix(word + mix(wp.uint32(cell))) + mix(wp.uint32(frame)))


@wp.func
def is_first_of_tile(samples: SortedSamples, i: int) -> bool:
    """Returns whether element ``i`` of the sorted samples is the first one of its tile."""
    if samples.keys[i] == NO_TILE:
        return False
    return i == 0 or samples.keys[i] != samples.keys[wp.max(i - 1, 0)]


@wp.func
def is_first_of_cell(samples: SortedSamples, i: int) -> bool:
    """Returns whether element ``i`` of the sorted samples is the first one of its cell."""
    if samples.keys[i] == NO_TILE:
        return False
    before = wp.max(i - 1, 0)
    same_cell = samples.cells[samples.order[i]] == samples.cells[samples.order[before]]
    return i == 0 or samples.keys[i] != samples.keys[before] or not same_cell
