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
"""Offset, in cells, of the boundaries between layers of cells.

Walls often lie at whole numbers, halves or quarters, where rounding would put their points into two layers."""

TILE_CELLS: int = wp.constant(64)
"""Number of cells of a tile."""

TILE_MEANS: int = wp.constant(85)
"""Number of means of a tile: 64 + 16 + 4 + 1."""

TILE_MIPS: int = wp.constant(4)
"""Number of mip levels of a tile's means: squares 1, 2, 4 and 8 cells wide."""

NO_TILE: wp.int64 = wp.constant(wp.int64(2**63 - 1))
"""Key that stands for no tile; larger than all keys of tiles."""

LEVEL_LAST: int = wp.constant(16)
"""Largest level plus 1: cells are 2^-LEVEL_LAST to 2^(LEVEL_LAST - 1) scene units wide, which takes 5 bits of the key.
"""

NEAR_LEVELS: int = wp.constant(3)
"""Number of levels by which cells of short rays are finer: a tile of theirs is as wide as one cell of long rays."""

COORDINATE_BITS: int = wp.constant(18)
"""Number of key bits for each coordinate of a tile."""

CELLS_REACH: float = wp.constant(8191.0)
"""Limit of cell coordinates: a cell is at least as wide as its largest coordinate over this number.

Widths are then rounded down to a power of two, and cells of short rays are eight times narrower; the coordinates of all
cells fit the key.
"""

REFLECTANCE_MAX: float = wp.constant(0.99)
"""Upper limit of the albedo for cached light, so that interreflection between white walls converges."""

AGE_LAST: int = wp.constant(2**31 - 1)
"""Frame number that stands for no tile; larger than all frame numbers."""

COUNT_LIVE: int = wp.constant(0)
"""Index in ``CacheTiles.counts`` of the number of live tiles."""

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
    """Hits of rays, as samples that are added to the cache or looked up in it; one element for each ray."""

    is_active: wp.array[bool]
    """False: the ray hit nothing, and the other fields are undefined."""
    position: wp.array[wp.vec3]
    """Hit position, world space."""
    normal: wp.array[wp.vec3]
    """Surface normal, unit, towards the ray's origin, world space."""
    direction: wp.array[wp.vec3]
    """Direction of the ray, unit, world space."""
    distance: wp.array[float]
    """Length of the ray, scene units."""
    from_eye: wp.array[float]
    """Distance of the hit from the eye, scene units; cells grow with it."""
    albedo: wp.array[wp.vec3]
    """Diffuse albedo of the hit surface, linear."""
    radiance: wp.array[wp.vec3]
    """Linear radiance that the surface reflects from lights and environment directly, without emission."""
    extent: wp.array[float]
    """Position uncertainty of the surface, scene units: the largest scale of its Gaussian; 0 for meshes."""


@struct
class CachePoints:
    """Points in cells from which rays gather indirect light, one element for each ray.

    The points of one cell are adjacent, as are those of one tile.
    """

    is_active: wp.array[bool]
    """False: there is no point, and the other fields are undefined."""
    position: wp.array[wp.vec3]
    """Position of the point, world space."""
    normal: wp.array[wp.vec3]
    """Surface normal at the point, unit, world space."""
    extent: wp.array[float]
    """Position uncertainty of the sample from which the point was made, scene units."""
    key: wp.array[wp.uint32]
    """Key of the random numbers of the cell's rays, see ``device/math/random.py``.

    The key depends on cell and frame, but not on the slot of the tile."""
    ray: wp.array[int]
    """Index of the ray among the rays of its cell, from 0."""
    rays: wp.array[int]
    """Number of rays of the point's cell."""
    slot: wp.array[int]
    """Slot of the point's tile; -1: there is no point."""
    cell: wp.array[int]
    """Index of the point's cell in its tile, in row order."""


@struct
class CacheGrid:
    """Settings of the cache for kernels."""

    cell_size: float
    """Largest width of a cell as a fraction of its distance from the eye."""
    history: float
    """Number of frames over which direct light is averaged."""
    bounce_history: float
    """Number of rays over which indirect light is averaged."""
    samples_min: float
    """Number of samples below which a mean counts as noisy."""
    tiles: int
    """Largest number of tiles that the cache holds."""


@struct
class CacheTiles:
    """Live tiles of the cache.

    The keys of the tiles are sorted; the data of a tile stay in one slot. ``slots`` is a permutation of all slots:
    those of the live tiles, then the free ones.
    """

    counts: wp.array[int]
    """Numbers of tiles, at the indices ``COUNT_LIVE`` to ``COUNT_DROPPED``."""
    keys: wp.array[wp.int64]
    """Keys of the live tiles in ascending order, then ``NO_TILE``."""
    slots: wp.array[int]
    """Slot of the tile with each key of ``keys``, then the free slots."""
    used: wp.array[int]
    """Number of the last frame in which a ray hit the tile, by slot."""
    bounced: wp.array[int]
    """One more than the last frame in which the tile's cells sent rays, by slot; 0: never."""
    filled: wp.array[int]
    """Number of cells of the tile that have samples, by slot."""
    direct: wp.array[wp.vec4]
    """Mean linear radiance reflected from lights directly, and the number of its samples; ``TILE_MEANS`` for each
    slot."""
    indirect: wp.array[wp.vec4]
    """Mean incident indirect radiance, cosine-weighted and linear (irradiance over pi), and the number of its rays.

    There are ``TILE_MEANS`` for each slot. Incident radiance is stored because the surfaces of a cell may differ in
    albedo."""
    frames: wp.array[int]
    """Number of frames in which each cell had samples, at most ``history``; 0: empty. ``TILE_CELLS`` for each slot."""
    updated: wp.array[int]
    """Number of the last frame in which each cell had samples, by slot and cell."""
    position: wp.array[wp.vec3]
    """World-space position of one sample of each cell from frame ``updated``, by slot and cell."""
    normal: wp.array[wp.vec3]
    """Normal of the sample at ``position``."""
    extent: wp.array[float]
    """Position uncertainty of the sample at ``position``, scene units."""


@struct
class SortedSamples:
    """Cache samples sorted by tile, cell and index."""

    keys: wp.array[wp.int64]
    """Keys of the samples' tiles, ascending; ``NO_TILE`` for samples without a tile.

    The second half of the array is scratch space for the sort."""
    order: wp.array[int]
    """Indices of the samples in sorted order; the second half of the array is scratch space for the sort."""
    cells: wp.array[int]
    """Index of each sample's cell in its tile, by sample index."""


SHIFT = wp.constant(wp.float32(LAYER_SHIFT))

COORDINATE_MASK = wp.constant(2**18 - 1)

BITS_32 = wp.constant(wp.int64(32))

KEY_ORIGIN = wp.constant(wp.uint32(0x63616368))
"""Initial state from which the random keys of cells are computed, distinct from that of pixels."""


@wp.struct
class CacheCell:
    """Tile and cell of a sample."""

    key: wp.int64
    """Key of the tile; ``NO_TILE``: the sample has no cell."""
    cell: int
    """Index of the cell in the tile, in row order."""


@wp.struct
class CellLight:
    """Linear radiance that leaves a sample's surface, looked up in the cache."""

    direct: wp.vec3
    """Reflected direct light of lights and environment."""
    indirect: wp.vec3
    """Reflected light of other surfaces."""
    is_valid: bool
    """True if any ray has sampled the indirect light."""


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
    """Returns the level of the cells for long rays at a position; cells are 2^level scene units wide."""
    reach = wp.max(wp.abs(position))
    width = wp.max(grid.cell_size * from_eye, reach / CELLS_REACH)
    # The next coarser and finer levels and the levels of short rays must exist, too.
    return wp.clamp(exponent_of(width), NEAR_LEVELS - LEVEL_LAST, LEVEL_LAST - 2)


@wp.func
def face_of(normal: wp.vec3) -> int:
    """Returns the face, 0 to 5, of a normal: twice the index of its dominant axis, plus 1 if it is negative there."""
    axis = int(2)
    if wp.abs(normal[0]) >= wp.abs(normal[1]) and wp.abs(normal[0]) >= wp.abs(normal[2]):
        axis = 0
    elif wp.abs(normal[1]) >= wp.abs(normal[2]):
        axis = 1
    return 2 * axis + int(normal[axis] < 0.0)


@wp.func
def with_coordinate(key: wp.int64, coordinate: int) -> wp.int64:
    """Appends a coordinate to a key as its lowest bits."""
    return (key << wp.int64(COORDINATE_BITS)) | wp.int64(coordinate & COORDINATE_MASK)


@wp.func
def cell_at(position: wp.vec3, normal: wp.vec3, level: int, is_near: bool) -> CacheCell:
    """Returns the cell of a given level at a position with a surface normal.

    ``is_near`` selects cells of short rays instead of those of long rays.
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
        head = wp.int64(2 * (8 * (level + LEVEL_LAST) + face) + int(is_near))
        cell.key = with_coordinate(with_coordinate(with_coordinate(head, u >> 3), v >> 3), w)
        cell.cell = 8 * (v & 7) + (u & 7)
    return cell


@wp.func
def is_of_short_rays(key: wp.int64) -> bool:
    """Returns whether a tile has cells of short rays, which the key bit before the three coordinates tells."""
    return ((key >> wp.int64(3 * COORDINATE_BITS)) & wp.int64(1)) != wp.int64(0)


@wp.func
def is_near(samples: CacheSamples, i: int, level: int) -> bool:
    """Returns whether ray ``i`` is shorter than a cell of this level is wide.

    The ray's origin may then lie on the other side of a wall from the rest of the cell.
    """
    return samples.distance[i] < width_of(level) + samples.extent[i]


@wp.func
def cell_of_sample(grid: CacheGrid, samples: CacheSamples, i: int) -> CacheCell:
    """Returns the cell that a sample is stored in."""
    level = level_of(grid, samples.position[i], samples.from_eye[i])
    near = is_near(samples, i, level)
    if near:
        level -= NEAR_LEVELS
    return cell_at(samples.position[i], samples.normal[i], level, near)


@wp.func
def slot_of(tiles: CacheTiles, key: wp.int64) -> int:
    """Returns the slot of the tile with a key; -1: the cache has no such tile."""
    live = tiles.counts[COUNT_LIVE]
    rank = first_not_below(tiles.keys, live, key)
    if rank < live:
        if tiles.keys[rank] == key:
            return tiles.slots[rank]
    return -1


@wp.func
def mean_index(slot: int, cell: int, mip: int) -> int:
    """Returns the index of the mean over the square of 2^mip x 2^mip cells that contains a cell."""
    side = 8 >> mip
    before = (4 * (TILE_CELLS - side * side)) // 3
    return slot * TILE_MEANS + before + ((cell >> 3) >> mip) * side + ((cell & 7) >> mip)


@wp.func
def reliable_mean(means: wp.array[wp.vec4], slot: int, cell: int, samples_min: float, best: wp.vec4) -> wp.vec4:
    """Returns ``best`` if it has ``samples_min`` samples, else the finest mean around a cell that has as many.

    If none has that many, the mean with the most samples is returned.
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
    """Returns the radiance of a stored mean, whose fourth component is the number of samples."""
    return wp.vec3(mean[0], mean[1], mean[2])


@wp.func
def reflected_light(samples: CacheSamples, i: int, indirect: wp.vec4) -> wp.vec3:
    """Returns the radiance that a sample's surface reflects from the indirect light of its cell."""
    return wp.cw_mul(wp.min(samples.albedo[i], wp.vec3(REFLECTANCE_MAX)), color_of(indirect))


@wp.func
def long_ray_radiance(
    tiles: CacheTiles, grid: CacheGrid, samples: CacheSamples, i: int, position: wp.vec3, level: int
) -> CellLight:
    """Looks up the direct and indirect radiance of a sample of a long ray at a position in the sample's plane.

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
    """Returns the linear radiance leaving a sample's surface, over all bounces, without emission.

    For a short ray, the direct radiance is the sample's own, and the indirect radiance is that of the fine cells for
    short rays, because a mean over a larger cell may leak through a wall.
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
    """Returns the key of a cell's random numbers in a frame."""
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
