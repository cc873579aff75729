"""Cells of the radiance cache: which one a hit is in, and what is known there.

docs/method/realtime.md#radiance-cache
"""

import warp as wp

from lumisplat.constants.realtime import LAYER_SHIFT
from lumisplat.device.math.random import mix
from lumisplat.device.math.search import first_not_below
from lumisplat.device.structs.radiance_cache import (
    CELLS_REACH,
    COORDINATE_BITS,
    COUNT_LIVE,
    LEVEL_LAST,
    NEAR_LEVELS,
    NO_TILE,
    REFLECTANCE_MAX,
    TILE_CELLS,
    TILE_MEANS,
    TILE_MIPS,
    CacheGrid,
    CacheSamples,
    CacheTiles,
    SortedSamples,
)

wp.set_module_options({"enable_backward": False})

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
    is_known: bool
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
    place = CacheCell()
    place.key = NO_TILE
    scaled = position / width_of(level)
    # False for infinities and NaN, too.
    if wp.max(wp.abs(scaled)) < float(COORDINATE_MASK // 2) and wp.isfinite(normal):
        face = face_of(normal)
        axis = face // 2
        u = int(wp.floor(scaled[(axis + 1) % 3]))
        v = int(wp.floor(scaled[(axis + 2) % 3]))
        w = int(wp.floor(scaled[axis] + SHIFT))
        head = wp.int64(2 * (8 * (level + LEVEL_LAST) + face) + int(is_near))
        place.key = with_coordinate(with_coordinate(with_coordinate(head, u >> 3), v >> 3), w)
        place.cell = 8 * (v & 7) + (u & 7)
    return place


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
def well_known(means: wp.array[wp.vec4], slot: int, cell: int, samples_min: float, known: wp.vec4) -> wp.vec4:
    """What is known, if it is of enough samples; else the finest mean around a cell that is, or that of the most."""
    if known[3] >= samples_min or slot < 0:
        return known
    for mip in range(TILE_MIPS):
        mean = means[mean_index(slot, cell, mip)]
        if mean[3] > known[3]:
            known = mean
        if known[3] >= samples_min:
            break
    return known


@wp.func
def color_of(mean: wp.vec4) -> wp.vec3:
    """The radiance of a mean, without its number of samples."""
    return wp.vec3(mean[0], mean[1], mean[2])


@wp.func
def reflected_light(samples: CacheSamples, i: int, indirect: wp.vec4) -> wp.vec3:
    """What a sample's surface reflects of a cell's mean of light from other surfaces."""
    return wp.cw_mul(wp.min(samples.albedo[i], wp.vec3(REFLECTANCE_MAX)), color_of(indirect))


@wp.func
def far_radiance(
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
            place = cell_at(position, samples.normal[i], level + (step & 1) - (step >> 1), False)
            slot = slot_of(tiles, place.key)
            direct = well_known(tiles.direct, slot, place.cell, grid.samples_min, direct)
            indirect = well_known(tiles.indirect, slot, place.cell, grid.samples_min, indirect)
    light = CellLight()
    light.direct = samples.radiance[i]
    if direct[3] > 0.0:
        light.direct = color_of(direct)
    light.indirect = reflected_light(samples, i, indirect)
    light.is_known = indirect[3] > 0.0
    return light


@wp.func
def cached_radiance(tiles: CacheTiles, grid: CacheGrid, samples: CacheSamples, i: int) -> wp.vec3:
    """Linear radiance that leaves a sample's surface, of light of all bounces, without what it emits.

    A short ray takes the sample's own direct radiance, and the indirect one of the fine cells of short rays: no mean
    over a cell that may reach through a wall.
    """
    level = level_of(grid, samples.position[i], samples.from_eye[i])
    if is_near(samples, i, level):
        place = cell_at(samples.position[i], samples.normal[i], level - NEAR_LEVELS, True)
        near = well_known(tiles.indirect, slot_of(tiles, place.key), place.cell, 1.0, wp.vec4())
        if near[3] > 0.0:
            return samples.radiance[i] + reflected_light(samples, i, near)
        return samples.radiance[i] + far_radiance(tiles, grid, samples, i, samples.position[i], level).indirect
    far = far_radiance(tiles, grid, samples, i, samples.position[i], level)
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
