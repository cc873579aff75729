"""Screen probes: their data, where they are, and which of the frame before they continue.

The equations are in docs/method/realtime.md#screen-probes.
"""

import warp as wp

from lumisplat.device.camera.camera import ORTHOGRAPHIC, pixel_of_point
from lumisplat.device.gi.surfaces import SurfacePixels
from lumisplat.device.math.random import reversed_bits
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData


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
    refresh_count: wp.array[int]
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
    sh: wp.array[wp.vec3]
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
class ProbePlacement:
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


SEARCH_ROWS = wp.constant(8)
"""Rows and columns of a tile whose pixels are looked at."""

COSINE_MIN_SPLATS = wp.constant(wp.float32(0.5))
"""Normals of Gaussians that differ by less agree: they are noisy."""

COSINE_MIN_MESHES = wp.constant(wp.float32(0.95))

SHARE_MIN = wp.constant(wp.float32(0.5))
"""A surface that is less of its pixel gets a probe only where there is no better one."""

POORER = wp.constant(wp.float32(1e12))
"""Added to what is compared for such surfaces."""

SECOND = wp.constant(wp.float32(1e6))
"""Added to the distance of an adaptive probe that a tile's own would continue: the two must not change places."""

CUT_OFF_STEPS = wp.constant(4)
"""Parts of the way from a pixel to a probe, between which it is looked whether a nearer surface cuts the probe off."""

NEARER = wp.constant(wp.float32(0.95))
"""How far away such a surface is at most, as a share of the nearer of the two."""

AS_FAR = wp.constant(wp.float32(0.85))
"""Least share of the larger distance from the eye: a tile of a floor that is seen at a slant may be metres long."""

UNIT_32 = wp.constant(wp.float32(2.0**-32))


@wp.func
def reach_of(grid: ProbeGrid, camera: CameraData, distance: float) -> float:
    """How wide a tile is at a distance, scene units: points of one plane, to this, may share a probe."""
    width = float(grid.tile) / wp.min(camera.focal[0], camera.focal[1])
    if camera.model == ORTHOGRAPHIC:
        return width
    return width * distance


@wp.func
def fits(probes: ProbeData, i: int, position: wp.vec3, normal: wp.vec3, reach: float, extent: float) -> bool:
    """Whether probe ``i`` is on the surface of a point: near its plane, and facing as it does."""
    if i < 0:
        return False
    if probes.is_placed[i] == 0:
        return False
    extent = wp.max(extent, probes.extent[i])
    cosine_min = wp.where(extent > 0.0, COSINE_MIN_SPLATS, COSINE_MIN_MESHES)
    if wp.dot(normal, probes.normal[i]) <= cosine_min:
        return False
    return wp.abs(wp.dot(normal, probes.position[i] - position)) < wp.max(reach, extent)


@wp.func
def is_cut_off(pixel: int, probe: int, grid: ProbeGrid, surfaces: SurfacePixels, probes: ProbeData) -> bool:
    """Whether a nearer surface, such as the end of a wall, is between a pixel and a probe in the image."""
    start = wp.vec2(float(pixel % grid.width) + 0.5, float(pixel // grid.width) + 0.5)
    to_probe = probes.pixel[probe] - start
    nearer = NEARER * wp.min(surfaces.distance[pixel], probes.distance[probe])
    for k in range(1, CUT_OFF_STEPS):
        at = start + (float(k) / float(CUT_OFF_STEPS)) * to_probe
        between = int(at[1]) * grid.width + int(at[0])
        if surfaces.share[between] > 0.0 and surfaces.distance[between] < nearer:
            return True
    return False


@wp.func
def tile_of(grid: ProbeGrid, x: int, y: int) -> int:
    """The tile at a column and row of tiles; -1: there is none."""
    if x < 0 or y < 0 or x >= grid.tiles_x or y >= grid.tiles_y:
        return -1
    return y * grid.tiles_x + x


@wp.func
def probe_of_tile(tile: int, adaptive: int, adaptive_of: wp.array[int]) -> int:
    """The tile's own probe (``adaptive`` 0) or its adaptive one (1); -1: there is none."""
    if tile < 0 or adaptive == 0:
        return tile
    return adaptive_of[tile]


@wp.func
def radical_inverse_3(number: int) -> float:
    """The digits of a number to the base 3, mirrored at the point."""
    value = float(0.0)
    digit = float(1.0 / 3.0)
    while number > 0:
        rest = number // 3
        value += digit * float(number - 3 * rest)
        digit /= 3.0
        number = rest
    return value


@wp.func
def wanted_pixel(grid: ProbeGrid, tile: int) -> wp.vec2:
    """Where in a tile a new probe of this frame would be best, 0..1: Halton points, shifted from tile to tile."""
    number = grid.frame % 4096 + 1
    x = float(wp.rshift(reversed_bits(wp.uint32(number)), wp.uint32(8))) * 256.0 * UNIT_32
    y = radical_inverse_3(number)
    x += 0.7548776662466927 * float(tile % 1024)  # 1 over the plastic number, and over its square: spread evenly
    y += 0.5698402909980532 * float(tile % 1024)
    return wp.vec2(x - wp.floor(x), y - wp.floor(y))


@wp.func
def match_of(
    grid: ProbeGrid,
    camera: CameraData,
    pixel: int,
    of_adaptive: bool,
    surfaces: SurfacePixels,
    probes: ProbeData,
    adaptive_of: wp.array[int],
) -> Match:
    """The nearest probe of the frame before on the surface of a pixel, in the tile that showed it then.

    It is the nearest one in the image: in space, of a floor that is seen at a slant, near rows would always win.
    Camera, probes and ``adaptive_of`` are those of the frame before; ``of_adaptive``: for an adaptive probe.
    """
    match = Match()
    match.probe = -1
    match.distance = wp.inf
    position = surfaces.previous[pixel]
    at = pixel_of_point(camera, position)
    if not (at[0] >= 0.0 and at[1] >= 0.0 and at[0] < float(grid.width) and at[1] < float(grid.height)):
        return match
    tile = tile_of(grid, int(at[0]) // grid.tile, int(at[1]) // grid.tile)
    reach = reach_of(grid, camera, wp.length(position - camera.eye))
    for adaptive in range(2):
        i = probe_of_tile(tile, adaptive, adaptive_of)
        if fits(probes, i, position, surfaces.normal[pixel], reach, surfaces.extent[pixel]):
            distance = wp.length(pixel_of_point(camera, probes.position[i]) - at)
            if adaptive == 1 and not of_adaptive:
                distance += SECOND
            if probes.refresh_count[i] > 0 and distance < match.distance:
                match.probe = i
                match.distance = distance
    return match


@wp.func
def is_as_far(distance: float, other: float) -> bool:
    """Whether two points of one surface are so near to each other that one probe is enough, by how far they are."""
    return wp.min(distance, other) > AS_FAR * wp.max(distance, other)


@wp.func
def is_covered(grid: ProbeGrid, camera: CameraData, x: int, y: int, surfaces: SurfacePixels, probes: ProbeData) -> bool:
    """Whether one of the four tiles around a pixel has a probe on its surface; adaptive ones do not count."""
    pixel = y * grid.width + x
    reach = reach_of(grid, camera, surfaces.distance[pixel])
    left = (x + grid.tile // 2) // grid.tile - 1
    above = (y + grid.tile // 2) // grid.tile - 1
    for k in range(4):
        i = tile_of(grid, left + k % 2, above + k // 2)
        if fits(probes, i, surfaces.position[pixel], surfaces.normal[pixel], reach, surfaces.extent[pixel]):
            if is_as_far(surfaces.distance[pixel], probes.distance[i]) and not is_cut_off(
                pixel, i, grid, surfaces, probes
            ):
                return True
    return False


@wp.func
def choose_pixel_among(
    rows: int,
    tile: int,
    only_uncovered: bool,
    grid: ProbeGrid,
    camera: CameraData,
    camera_before: CameraData,
    surfaces: SurfacePixels,
    probes: ProbeData,
    probes_before: ProbeData,
    adaptive_before: wp.array[int],
) -> ProbePlacement:
    """The pixel of a tile for a probe: nearest to one of the frame before, else to where a new one is wanted.

    ``rows`` x ``rows`` pixels of the tile are looked at; with ``only_uncovered``, those count that no probe of this
    frame covers.
    """
    placement = ProbePlacement()
    placement.pixel = -1
    placement.source = -1
    placement.uncovered = 0
    corner_y = tile // grid.tiles_x * grid.tile
    corner_x = tile % grid.tiles_x * grid.tile
    wanted = wanted_pixel(grid, tile) * float(grid.tile)
    fresh_cost = float(wp.inf)
    match_cost = float(wp.inf)
    for k in range(rows * rows):
        across = k % rows * grid.tile // rows
        down = k // rows * grid.tile // rows
        x = corner_x + across
        y = corner_y + down
        if x < grid.width and y < grid.height:
            pixel = y * grid.width + x
            counts = surfaces.share[pixel] > 0.0
            if counts and only_uncovered:
                counts = not is_covered(grid, camera, x, y, surfaces, probes)
            if counts:
                placement.uncovered += 1
                poorer = wp.where(surfaces.share[pixel] < SHARE_MIN, POORER, 0.0)
                cost = poorer + wp.length_sq(wp.vec2(float(across), float(down)) - wanted)
                if cost < fresh_cost:
                    fresh_cost = cost
                    if placement.source < 0:
                        placement.pixel = pixel
                if grid.has_history != 0:
                    match = match_of(
                        grid, camera_before, pixel, only_uncovered, surfaces, probes_before, adaptive_before
                    )
                    if match.probe >= 0 and poorer + match.distance < match_cost:
                        match_cost = poorer + match.distance
                        placement.pixel = pixel
                        placement.source = match.probe
    return placement


@wp.func
def choose_pixel_in_tile(
    tile: int,
    grid: ProbeGrid,
    camera: CameraData,
    camera_before: CameraData,
    surfaces: SurfacePixels,
    probes_before: ProbeData,
    adaptive_before: wp.array[int],
) -> ProbePlacement:
    """The pixel for a tile's own probe, as ``place_among``: if those looked at show nothing, one of all others."""
    placement = choose_pixel_among(
        SEARCH_ROWS, tile, False, grid, camera, camera_before, surfaces, probes_before, probes_before, adaptive_before
    )
    if placement.pixel < 0:
        placement = choose_pixel_among(
            grid.tile, tile, False, grid, camera, camera_before, surfaces, probes_before, probes_before, adaptive_before
        )
    return placement
