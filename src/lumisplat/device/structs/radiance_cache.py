"""Data of the cache of radiance in world space. One struct is one noun of the method.

Cells are squares in the plane of one of six faces, one cell thick; 8 x 8 of them are a tile. A tile's means are 85: of
its cells row by row, then of squares of 2 x 2, 4 x 4 and 8 x 8 cells. docs/method/realtime.md#radiance-cache
"""

import warp as wp

from lumisplat.device.structs.declare import struct

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
