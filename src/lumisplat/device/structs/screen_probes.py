"""Data of screen probes. One struct is one noun of the method (docs/method/realtime.md#screen-probes)."""

import warp as wp

from lumisplat.device.structs.declare import struct


@struct
class ProbeGrid:
    """How probes lie on the pixels of a frame. Lives in a 1-element array.

    Probe ``t`` is that of tile ``t``, row by row; those behind the tiles' are adaptive ones.
    """

    width: int
    height: int
    tile: int
    """Side of a tile, pixels."""
    tiles_x: int
    tiles_y: int
    adaptive: int
    """Most adaptive probes."""
    cells: int
    """Cells along a side of a probe's map."""
    history: float
    """Most samples that a cell's mean counts for."""
    offset: float
    """Scales of a Gaussian within which Gaussians do not block the rays of its probe."""
    frame: int
    has_history: int
    """0: the frame before is another sequence's."""
    seed: wp.uint32


@struct
class ProbeData:
    """Probes: where they are, and what is known of them; one element each."""

    is_placed: wp.array[int]
    """1: the probe exists; 0: the other fields are undefined."""
    position: wp.array[wp.vec3]
    """World space."""
    pixel: wp.array[wp.vec2]
    """Where the frame shows it: the centre of a pixel."""
    normal: wp.array[wp.vec3]
    """Of the surface, unit, towards the viewer."""
    distance: wp.array[float]
    """From the eye, scene units."""
    extent: wp.array[float]
    """As of `SurfacePixels`: 0 for meshes."""
    source: wp.array[int]
    """Probe of the frame before that it continues; -1: none."""
    rounds: wp.array[int]
    """How often it has been refreshed."""
    refreshed: wp.array[int]
    """Last frame in which it was; undefined if never."""


@struct
class ProbeCells:
    """The cells of all probes, probe after probe, each row by row."""

    radiance: wp.array[wp.vec3]
    """Mean, linear."""
    nearness: wp.array[float]
    """Mean of one over the distance to what is seen; 0: the sky."""
    samples: wp.array[float]
    """How many samples the means count for; 0: they are undefined."""


@struct
class ProbeLight:
    """What pixels look up: the cells of probes, filtered and without gaps, and their harmonics."""

    exists: wp.array[int]
    """1: the probe has light; one element a probe."""
    radiance: wp.array[wp.vec3]
    """Of cells, as `ProbeCells`."""
    harmonics: wp.array[wp.vec3]
    """Nine coefficients a probe, of the order of ``lumisplat.math.sh``."""


@struct
class TileNeeds:
    """The pixels of a tile that no probe covers, and where another one should be; one element a tile."""

    uncovered: wp.array[int]
    """How many of the pixels that are looked at."""
    pixel: wp.array[int]
    """Where it should be."""
    source: wp.array[int]
    """As of `ProbeData`."""


@struct
class ProbePlace:
    """A pixel for a probe."""

    pixel: int
    """-1: there is none."""
    source: int
    """As of `ProbeData`."""
    uncovered: int
    """As of `TileNeeds`; 0 where nobody asks."""


@struct
class Match:
    """A probe of the frame before, and how far a point is from it."""

    probe: int
    """-1: none."""
    distance: float
    """Scene units; more for one that should rather not be continued."""


@struct
class Ballot:
    """What probes say of a pixel, weighted."""

    total: wp.vec3
    weight: float
