"""The cache of radiance in world space: its data, which cell a hit is in, and the radiance that is stored there.

Cells are squares in the plane of one of six faces, one cell thick; 8 x 8 of them are a tile. A tile's means are 85: of
its cells row by row, then of squares of 2 x 2, 4 x 4 and 8 x 8 cells. docs/method/realtime.md#radiance-cache
"""

import warp as wp

from lumisplat.device.math.random import mix
from lumisplat.device.math.sorting import first_not_below
from lumisplat.device.structs import struct

LAYER_SHIFT = 0.382
"""Where, in cells, layers of cells begin: walls lie at whole numbers, halves or quarters, where rounding would put
their points into two layers."""

TILE_CELLS: int = wp.constant(64)
"""Cells of a tile."""

TILE_MEANS: int = wp.constant(85)
"""Its means: 64 + 16 + 4 + 1."""

TILE_MIPS: int = wp.constant(4)
"""Sizes of the squares that means are over: 1, 2, 4 and 8 cells wide."""

NO_TILE: wp.int64 = wp.constant(wp.int64(2**63 - 1))
"""Key where there is no tile: greater than all others."""

LEVEL_LAST: int = wp.constant(16)
"""Widths of cells are 2^-LEVEL_LAST to 2^(LEVEL_LAST - 1) scene units: 5 bits of the key."""

NEAR_LEVELS: int = wp.constant(3)
"""Cells of short rays are finer by so many levels: a tile of them is as wide as one cell of long rays."""

COORDINATE_BITS: int = wp.constant(18)
"""Bits of the key for each coordinate of a tile."""

CELLS_REACH: float = wp.constant(8191.0)
"""Cells are no smaller than the largest coordinate of a position divided by this, nor finer ones by 1/16 of it: their
coordinates then fit."""

REFLECTANCE_MAX: float = wp.constant(0.99)
"""Albedo above which surfaces do not reflect what cells receive: light between white walls must die out."""

AGE_LAST: int = wp.constant(2**31 - 1)
"""Greater than all frames: where there is no tile."""

COUNT_LIVE: int = wp.constant(0)
"""Index of the number of tiles there are."""

COUNT_NEW: int = wp.constant(1)
"""Index of the number of tiles that an insertion adds."""

COUNT_EXCESS: int = wp.constant(2)
"""Index of the number of tiles that it would add beyond the capacity."""

COUNT_EVICTED: int = wp.constant(3)
"""Index of the number of tiles that went before their time, since the start."""

COUNT_DROPPED: int = wp.constant(4)
"""Index of the number of tiles that found no room, since the start."""

COUNTS: int = wp.constant(5)
"""Length of the array of these."""


@struct
class CacheSamples:
    """What rays have hit, one element a ray."""

    is_active: wp.array[bool]
    """False: the ray hit nothing; the other fields are undefined."""
    position: wp.array[wp.vec3]
    """World space."""
    normal: wp.array[wp.vec3]
    """Of the surface, unit, towards where the ray came from, world space."""
    direction: wp.array[wp.vec3]
    """Of the ray, unit, world space."""
    distance: wp.array[float]
    """Length of the ray, scene units."""
    from_eye: wp.array[float]
    """Distance of the position from the camera's eye, scene units: cells are larger farther away."""
    albedo: wp.array[wp.vec3]
    """Share of irradiance that the surface reflects diffusely, linear."""
    radiance: wp.array[wp.vec3]
    """Linear radiance that it reflects of the light of lamps and sky, without what it emits."""
    extent: wp.array[float]
    """How far the surface may be from where it is said to be, scene units: the largest scale of its Gaussian; 0 for
    meshes."""


@struct
class CachePoints:
    """Points of cells from which rays look for the light that the cells receive, one element a ray.

    Points of one cell are neighbours, and those of one tile.
    """

    is_active: wp.array[bool]
    """False: there is none; the other fields are undefined."""
    position: wp.array[wp.vec3]
    """World space."""
    normal: wp.array[wp.vec3]
    """Unit, world space."""
    extent: wp.array[float]
    """As in the sample that the point is of, scene units."""
    key: wp.array[wp.uint32]
    """Key of the random numbers of the cell's rays, see ``device/math/random.py``: of cell and frame, whatever the
    tile's slot is."""
    ray: wp.array[int]
    """Number of the ray among those of the cell, from 0."""
    rays: wp.array[int]
    """How many the cell has."""
    slot: wp.array[int]
    """Of the tile; -1: there is no point."""
    cell: wp.array[int]
    """Of the tile, row by row."""


@struct
class CacheGrid:
    """Settings of the cache, as kernels read them."""

    cell_size: float
    """Largest width of a cell as a share of its distance from the eye."""
    history: float
    """Frames that a mean of direct light is taken over."""
    bounce_history: float
    """Rays that a mean of indirect light is taken over."""
    samples_min: float
    """Samples below which a mean counts as noisy."""
    tiles: int
    """Capacity."""


@struct
class CacheTiles:
    """The tiles that there are.

    Their keys are sorted; what they hold stays in a slot each. ``slots`` is a permutation: those behind the live tiles'
    are free.
    """

    counts: wp.array[int]
    """``COUNT_LIVE`` to ``COUNT_DROPPED``."""
    keys: wp.array[wp.int64]
    """Ascending; ``NO_TILE`` behind the live ones."""
    slots: wp.array[int]
    """Slot of the tile with each key."""
    used: wp.array[int]
    """By slot: the last frame in which a ray hit it."""
    bounced: wp.array[int]
    """By slot: one more than the last frame in which rays left from its cells; 0: none yet."""
    filled: wp.array[int]
    """By slot: its cells with samples."""
    direct: wp.array[wp.vec4]
    """By slot, ``TILE_MEANS`` each: mean radiance reflected of lamps and sky, linear, and the samples it is of."""
    indirect: wp.array[wp.vec4]
    """Mean radiance that rays see along the cosine of the normal, linear: irradiance over pi, from other surfaces;
    samples are these rays. Surfaces of a cell may differ: each reflects its own share."""
    frames: wp.array[int]
    """By slot, ``TILE_CELLS`` each: frames with samples, at most ``history``; 0: the cell is empty."""
    updated: wp.array[int]
    """By slot and cell: the last of these frames."""
    position: wp.array[wp.vec3]
    """By slot and cell: one of the samples of that frame, world space."""
    normal: wp.array[wp.vec3]
    """Of that sample."""
    extent: wp.array[float]
    """Of that sample, scene units."""


@struct
class SortedSamples:
    """Samples by tile, cell and index."""

    keys: wp.array[wp.int64]
    """Of tiles, ascending; ``NO_TILE`` behind those that have one. Twice as long as there are samples, for the sort."""
    order: wp.array[int]
    """Indices of the samples; twice as long as there are."""
    cells: wp.array[int]
    """Cell of its tile, by index."""


SHIFT = wp.constant(wp.float32(LAYER_SHIFT))

COORDINATE_MASK = wp.constant(2**18 - 1)

BITS_32 = wp.constant(wp.int64(32))

KEY_ORIGIN = wp.constant(wp.uint32(0x63616368))
"""First state of the random numbers of cells, so that they share none with pixels."""


@wp.struct
class CacheCell:
    """Where a sample is."""

    key: wp.int64
    """Of its tile; ``NO_TILE``: it has none."""
    cell: int
    """Of the tile, row by row."""


@wp.struct
class CellLight:
    """What is known where a sample is: linear radiance that leaves the surface."""

    direct: wp.vec3
    """Of lamps and sky."""
    indirect: wp.vec3
    """Of other surfaces."""
    is_valid: bool
    """Whether anything is known of that."""


@wp.func
def exponent_of(value: float) -> int:
    """floor(log2(value)) of a positive number, without rounding: the same on every device."""
    return ((wp.cast(value, wp.int32) >> 23) & 255) - 127


@wp.func
def width_of(level: int) -> float:
    """Width of the cells of a level, scene units: 2^level."""
    return wp.cast((level + 127) << 23, wp.float32)


@wp.func
def level_of(grid: CacheGrid, position: wp.vec3, from_eye: float) -> int:
    """Level of the cells of long rays at a position."""
    reach = wp.max(wp.abs(position))
    width = wp.max(grid.cell_size * from_eye, reach / CELLS_REACH)
    # One coarser, one finer and the cells of short rays have levels, too.
    return wp.clamp(exponent_of(width), NEAR_LEVELS - LEVEL_LAST, LEVEL_LAST - 2)


@wp.func
def face_of(normal: wp.vec3) -> int:
    """Twice the dominant axis of a normal, plus 1 if it points down it."""
    axis = int(2)
    if wp.abs(normal[0]) >= wp.abs(normal[1]) and wp.abs(normal[0]) >= wp.abs(normal[2]):
        axis = 0
    elif wp.abs(normal[1]) >= wp.abs(normal[2]):
        axis = 1
    return 2 * axis + int(normal[axis] < 0.0)


@wp.func
def with_coordinate(key: wp.int64, coordinate: int) -> wp.int64:
    """A key with one more coordinate behind."""
    return (key << wp.int64(COORDINATE_BITS)) | wp.int64(coordinate & COORDINATE_MASK)


@wp.func
def cell_at(position: wp.vec3, normal: wp.vec3, level: int, is_near: bool) -> CacheCell:
    """The cell of a level at a position on a surface with this normal; ``is_near``: of short rays."""
    cell = CacheCell()
    cell.key = NO_TILE
    scaled = position / width_of(level)
    # False for infinities and NaN, too.
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
    """Whether the cells of a tile are those of short rays; the bit before the three coordinates."""
    return ((key >> wp.int64(3 * COORDINATE_BITS)) & wp.int64(1)) != wp.int64(0)


@wp.func
def is_near(samples: CacheSamples, i: int, level: int) -> bool:
    """Whether a ray is shorter than a cell: what it left may be on the other side of a wall from the rest of that."""
    return samples.distance[i] < width_of(level) + samples.extent[i]


@wp.func
def cell_of_sample(grid: CacheGrid, samples: CacheSamples, i: int) -> CacheCell:
    """The cell that a sample goes into."""
    level = level_of(grid, samples.position[i], samples.from_eye[i])
    near = is_near(samples, i, level)
    if near:
        level -= NEAR_LEVELS
    return cell_at(samples.position[i], samples.normal[i], level, near)


@wp.func
def slot_of(tiles: CacheTiles, key: wp.int64) -> int:
    """The slot of a tile; -1: there is no such tile."""
    live = tiles.counts[COUNT_LIVE]
    rank = first_not_below(tiles.keys, live, key)
    if rank < live:
        if tiles.keys[rank] == key:
            return tiles.slots[rank]
    return -1


@wp.func
def mean_index(slot: int, cell: int, mip: int) -> int:
    """Index of the mean over the square of 2^mip x 2^mip cells that a cell is in."""
    side = 8 >> mip
    before = (4 * (TILE_CELLS - side * side)) // 3
    return slot * TILE_MEANS + before + ((cell >> 3) >> mip) * side + ((cell & 7) >> mip)


@wp.func
def reliable_mean(means: wp.array[wp.vec4], slot: int, cell: int, samples_min: float, best: wp.vec4) -> wp.vec4:
    """What is known, if it is of enough samples; else the finest mean around a cell that is, or that of the most."""
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
    """The radiance of a mean, without its number of samples."""
    return wp.vec3(mean[0], mean[1], mean[2])


@wp.func
def reflected_light(samples: CacheSamples, i: int, indirect: wp.vec4) -> wp.vec3:
    """What a sample's surface reflects of a cell's mean of light from other surfaces."""
    return wp.cw_mul(wp.min(samples.albedo[i], wp.vec3(REFLECTANCE_MAX)), color_of(indirect))


@wp.func
def long_ray_radiance(
    tiles: CacheTiles, grid: CacheGrid, samples: CacheSamples, i: int, position: wp.vec3, level: int
) -> CellLight:
    """Direct and indirect radiance of a sample, at a place that is its own or in its plane beside it.

    It is from a level, else from the next coarser, else the next finer.

    Neighbouring levels know what is there when the camera has come nearer or gone.
    """
    direct = wp.vec4()
    indirect = wp.vec4()
    for step in range(3):
        if direct[3] < grid.samples_min or indirect[3] < grid.samples_min:
            # 0, 1, -1
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
    """Linear radiance that leaves a sample's surface, of light of all bounces, without what it emits.

    A short ray takes the sample's own direct radiance, and the indirect one of the fine cells of short rays: no mean
    over a cell that may reach through a wall.
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
    """Key of the random numbers of a cell in a frame."""
    low = wp.uint32(key & wp.int64(0xFFFFFFFF))
    high = wp.uint32(key >> BITS_32)
    word = mix(mix(KEY_ORIGIN + mix(low)) + mix(high))
    return mix(mix(word + mix(wp.uint32(cell))) + mix(wp.uint32(frame)))


@wp.func
def is_first_of_tile(samples: SortedSamples, i: int) -> bool:
    """Whether a sorted sample is the first of its tile."""
    if samples.keys[i] == NO_TILE:
        return False
    return i == 0 or samples.keys[i] != samples.keys[wp.max(i - 1, 0)]


@wp.func
def is_first_of_cell(samples: SortedSamples, i: int) -> bool:
    """Whether a sorted sample is the first of its cell."""
    if samples.keys[i] == NO_TILE:
        return False
    before = wp.max(i - 1, 0)
    same_cell = samples.cells[samples.order[i]] == samples.cells[samples.order[before]]
    return i == 0 or samples.keys[i] != samples.keys[before] or not same_cell
