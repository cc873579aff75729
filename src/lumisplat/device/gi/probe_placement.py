"""Screen probes: their data, their placement, and reprojection of probes of the previous frame.

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
    """Layout of the screen probes of a frame, in a 1-element array.

    Each tile of pixels has a probe of its own, with the index of the tile in row order, and may have an additional
    adaptive probe. Adaptive probes follow those of the tiles.
    """

    width: int
    height: int
    tile: int
    """Side of a tile, pixels."""
    tiles_x: int
    tiles_y: int
    adaptive: int
    """Largest number of adaptive probes."""
    cells: int
    """Number of cells along a side of a probe's octahedral map."""
    history: float
    """Largest number of samples as which the mean of a cell counts when a sample is added."""
    offset: float
    """Distance from a probe, in scales of a Gaussian, within which Gaussians do not block the probe's rays."""
    frame: int
    has_history: int
    """1: probes of the previous frame may be continued; 0: the previous frame belongs to another sequence."""
    seed: wp.uint32


@struct
class ProbeData:
    """Positions and refresh history of probes, one element for each probe."""

    is_placed: wp.array[int]
    """1: the probe exists; 0: the other fields are undefined."""
    position: wp.array[wp.vec3]
    """Position, world space."""
    pixel: wp.array[wp.vec2]
    """Position in the image, pixels: the centre of a pixel."""
    normal: wp.array[wp.vec3]
    """Surface normal, unit, towards the viewer."""
    distance: wp.array[float]
    """Distance from the eye, scene units."""
    extent: wp.array[float]
    """Position uncertainty of the probe's surface, scene units: the largest scale of its Gaussian; 0 for meshes."""
    source: wp.array[int]
    """Index of the probe of the previous frame that this probe continues; -1: this probe is new."""
    refresh_count: wp.array[int]
    """Number of times the probe was refreshed."""
    refreshed: wp.array[int]
    """Number of the last frame in which the probe was refreshed; undefined if it never was."""


@struct
class ProbeCells:
    """Cells of the probes' octahedral maps, probe by probe, in row order for each probe."""

    radiance: wp.array[wp.vec3]
    """Mean radiance that arrives from the cell's directions, linear."""
    nearness: wp.array[float]
    """Mean inverse hit distance of the cell's rays; 0: the rays escape."""
    samples: wp.array[float]
    """Number of samples as which the means count when a sample is added; 0: the means are undefined."""


@struct
class ProbeLight:
    """Light of the probes that pixels look up: filtered cells without gaps, and their SH coefficients."""

    exists: wp.array[int]
    """1: the probe has light that pixels can look up; one element for each probe."""
    radiance: wp.array[wp.vec3]
    """Radiance that arrives from each cell's directions, linear, ordered as in `ProbeCells`."""
    sh: wp.array[wp.vec3]
    """SH coefficients of the radiance, nine for each probe, in the order of ``lumisplat.math.sh``."""


@struct
class TileNeeds:
    """Pixels of each tile that no probe covers, and the best position of an adaptive probe for them."""

    uncovered: wp.array[int]
    """Number of pixels without a suitable probe, among those tested."""
    pixel: wp.array[int]
    """Index of the pixel at which the tile's adaptive probe should be placed."""
    source: wp.array[int]
    """Index of the probe of the previous frame that the tile's adaptive probe should continue; -1: none."""


@struct
class ProbePlacement:
    """Pixel chosen for a probe."""

    pixel: int
    """Index of the pixel; -1: none."""
    source: int
    """Index of the probe of the previous frame that the placed probe should continue; -1: none."""
    uncovered: int
    """Number of pixels at which the probe could be placed; for adaptive probes, pixels that no other probe covers."""


@struct
class Match:
    """A probe of the previous frame that matches a pixel."""

    probe: int
    """Index of the probe; -1: none."""
    distance: float
    """Distance to the probe in the image, pixels, plus ``ADAPTIVE_PENALTY`` where it applies."""


SEARCH_ROWS = wp.constant(8)
"""Number of rows and of columns of a tile in which pixels are tested."""

COSINE_MIN_SPLATS = wp.constant(wp.float32(0.5))
"""Smallest cosine between the normals of a pixel and a probe on the same Gaussians, whose normals are noisy."""

COSINE_MIN_MESHES = wp.constant(wp.float32(0.95))

SHARE_MIN = wp.constant(wp.float32(0.5))
"""Coverage of a pixel below which its surface gets a probe only if no pixel of the tile is covered more."""

LOW_COVERAGE_PENALTY = wp.constant(wp.float32(1e12))
"""Penalty that makes pixels covered by less than ``SHARE_MIN`` the last choice for a probe."""

ADAPTIVE_PENALTY = wp.constant(wp.float32(1e6))
"""Penalty, pixels, for a tile's own probe that would continue an adaptive probe, so that the two probes do not swap."""

CUT_OFF_STEPS = wp.constant(4)
"""Number of steps in the image from a pixel to a probe; after each step, an occluding surface is looked for."""

OCCLUDER_DISTANCE_MAX = wp.constant(wp.float32(0.95))
"""Largest distance of an occluding surface from the eye, as a fraction of the distance of the pixel or the probe.

The nearer of pixel and probe counts."""

DISTANCE_RATIO_MIN = wp.constant(wp.float32(0.85))
"""Smallest ratio of the distances from the eye of two points that may share a probe.

At grazing angles, the surface in a tile may be metres long."""

UNIT_32 = wp.constant(wp.float32(2.0**-32))


@wp.func
def reach_of(grid: ProbeGrid, camera: CameraData, distance: float) -> float:
    """Returns the width of a tile at a distance from the eye, scene units.

    Points this close to a common plane may share a probe.
    """
    width = float(grid.tile) / wp.min(camera.focal[0], camera.focal[1])
    if camera.model == ORTHOGRAPHIC:
        return width
    return width * distance


@wp.func
def fits(probes: ProbeData, i: int, position: wp.vec3, normal: wp.vec3, reach: float, extent: float) -> bool:
    """Returns whether probe ``i`` lies on the surface of a point: near its plane and with a similar normal."""
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
    """Returns whether a nearer surface, such as the end of a wall, lies between a pixel and a probe in the image."""
    start = wp.vec2(float(pixel % grid.width) + 0.5, float(pixel // grid.width) + 0.5)
    to_probe = probes.pixel[probe] - start
    nearer = OCCLUDER_DISTANCE_MAX * wp.min(surfaces.distance[pixel], probes.distance[probe])
    for k in range(1, CUT_OFF_STEPS):
        at = start + (float(k) / float(CUT_OFF_STEPS)) * to_probe
        between = int(at[1]) * grid.width + int(at[0])
        if surfaces.share[between] > 0.0 and surfaces.distance[between] < nearer:
            return True
    return False


@wp.func
def tile_of(grid: ProbeGrid, x: int, y: int) -> int:
    """Returns the tile at a column and row of tiles; -1: outside the image."""
    if x < 0 or y < 0 or x >= grid.tiles_x or y >= grid.tiles_y:
        return -1
    return y * grid.tiles_x + x


@wp.func
def probe_of_tile(tile: int, adaptive: int, adaptive_of: wp.array[int]) -> int:
    """Returns the index of a tile's own probe (``adaptive`` 0) or of its adaptive probe (1); -1: none."""
    if tile < 0 or adaptive == 0:
        return tile
    return adaptive_of[tile]


@wp.func
def radical_inverse_3(number: int) -> float:
    """Returns the radical inverse of a number in base 3."""
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
    """Returns the preferred position of a new probe in a tile for this frame, 0..1 along each side of the tile.

    The positions are Halton points over the frames, shifted from tile to tile.
    """
    number = grid.frame % 4096 + 1
    x = float(wp.rshift(reversed_bits(wp.uint32(number)), wp.uint32(8))) * 256.0 * UNIT_32
    y = radical_inverse_3(number)
    x += 0.7548776662466927 * float(tile % 1024)  # the inverse plastic number and its square give evenly spread shifts
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
    """Finds the previous frame's probe that is nearest to a pixel in the image and lies on the pixel's surface.

    The probe is searched in the tile that showed the surface in the previous frame. Distance is measured in the image:
    in space, nearer rows of a floor seen at a grazing angle would always win. ``camera``, ``probes`` and
    ``adaptive_of`` are those of the previous frame; ``of_adaptive`` selects matches for an adaptive probe.
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
                distance += ADAPTIVE_PENALTY
            if probes.refresh_count[i] > 0 and distance < match.distance:
                match.probe = i
                match.distance = distance
    return match


@wp.func
def is_similar_distance(distance: float, other: float) -> bool:
    """Returns whether two points of one surface have similar enough distances from the eye to share a probe."""
    return wp.min(distance, other) > DISTANCE_RATIO_MIN * wp.max(distance, other)


@wp.func
def is_covered(grid: ProbeGrid, camera: CameraData, x: int, y: int, surfaces: SurfacePixels, probes: ProbeData) -> bool:
    """Returns whether one of the four tiles around a pixel has a probe on the pixel's surface.

    Adaptive probes do not count.
    """
    pixel = y * grid.width + x
    reach = reach_of(grid, camera, surfaces.distance[pixel])
    left = (x + grid.tile // 2) // grid.tile - 1
    above = (y + grid.tile // 2) // grid.tile - 1
    for k in range(4):
        i = tile_of(grid, left + k % 2, above + k // 2)
        if fits(probes, i, surfaces.position[pixel], surfaces.normal[pixel], reach, surfaces.extent[pixel]):
            if is_similar_distance(surfaces.distance[pixel], probes.distance[i]) and not is_cut_off(
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
    """Chooses the pixel of a tile for a probe: nearest to a probe of the previous frame, if any lies on its surface.

    Otherwise the pixel nearest to the preferred position is chosen. ``rows`` x ``rows`` pixels of the tile are tested;
    with ``only_uncovered``, only pixels that no probe of this frame covers.
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
                poorer = wp.where(surfaces.share[pixel] < SHARE_MIN, LOW_COVERAGE_PENALTY, 0.0)
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
    """Chooses the pixel for a tile's own probe by ``choose_pixel_among``.

    If the tested pixels show no surface, all pixels of the tile are tested.
    """
    placement = choose_pixel_among(
        SEARCH_ROWS, tile, False, grid, camera, camera_before, surfaces, probes_before, probes_before, adaptive_before
    )
    if placement.pixel < 0:
        placement = choose_pixel_among(
            grid.tile, tile, False, grid, camera, camera_before, surfaces, probes_before, probes_before, adaptive_before
        )
    return placement
