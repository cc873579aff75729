"""Screen probes of real-time rendering: their data, placement, and reprojection from the previous frame.

The equations are in docs/method/realtime.md#screen-probes.
"""

import warp as wp

from lumisplat.device.camera.camera import ORTHOGRAPHIC, pixel_of_point
from lumisplat.device.gi.surfaces import PreviousImage, SurfacePixels
from lumisplat.device.math.random import reversed_bits
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData


@struct
class ProbeGrid:
    """Numbers and sizes of a frame's screen probes, in a 1-element array.

    Each tile of pixels has its own probe, numbered by tile in row order. A tile may also have one adaptive probe, for
    surfaces on which its own probe does not lie. Adaptive probes are numbered after the own probes of all tiles.
    """

    width: int
    height: int
    tile: int
    """Side of a tile, pixels."""
    tiles_x: int
    tiles_y: int
    adaptive: int
    """Largest number of adaptive probes in a frame."""
    cells: int
    """Number of cells along a side of a probe's octahedral map."""
    history: float
    """Largest weight, in samples, of a map cell's mean when a new sample is added to it."""
    offset: float
    """Gaussians nearer to a probe than this factor times the largest scale of the probe's Gaussian do not block the
    probe's rays."""
    frame: int
    has_history: int
    """1: the previous frame is of the same sequence, so that its probes are continued; 0: all probes start anew."""
    before: PreviousImage
    """Images of the previous frame, and thereby its tiles."""
    seed: wp.uint32


@struct
class ProbeData:
    """Surface points of the screen probes, and when each was refreshed; one element for each probe."""

    is_placed: wp.array[int]
    """1: the probe exists; 0: the other fields are undefined."""
    position: wp.array[wp.vec3]
    """World-space position of the probe on its surface."""
    pixel: wp.array[wp.vec2]
    """Position of the probe in the image, pixels; it is the centre of a pixel."""
    normal: wp.array[wp.vec3]
    """Unit surface normal at the probe, world space, towards the viewer."""
    distance: wp.array[float]
    """Distance of the probe from the eye, scene units."""
    extent: wp.array[float]
    """Position uncertainty of the probe's surface, scene units: the largest scale of its Gaussian; 0 for meshes."""
    source: wp.array[int]
    """Index of the probe of the previous frame that this probe continues; -1: this probe is new."""
    refresh_count: wp.array[int]
    """Number of frames in which the probe, or the previous probes that it continues, traced rays."""
    refreshed: wp.array[int]
    """Number of the last frame in which the probe traced rays; undefined if it never did."""


@struct
class ProbeCells:
    """Cells of the probes' octahedral maps of incoming light: probe by probe, and in row order within each map."""

    radiance: wp.array[wp.vec3]
    """Mean linear radiance that arrives at the probe from the cell's directions."""
    nearness: wp.array[float]
    """Mean of 1 / hit distance over the cell's rays, where escaped rays count as 0."""
    samples: wp.array[float]
    """Weight, in samples, of the cell's means when a new sample is added; 0: the cell has no means yet."""


@struct
class ProbeLight:
    """Incoming light of the screen probes for lookup by pixels: filtered between probes, and as SH."""

    exists: wp.array[int]
    """For each probe, 1 if it has light that pixels can look up, else 0."""
    radiance: wp.array[wp.vec3]
    """Filtered linear radiance that arrives from each map cell's directions, ordered as in `ProbeCells`."""
    sh: wp.array[wp.vec3]
    """Nine SH coefficients of each probe's radiance, in the basis order of ``lumisplat.math.sh``."""


@struct
class TileNeeds:
    """For each tile, how many pixels lie on no probe's surface, and where an adaptive probe would serve them."""

    uncovered: wp.array[int]
    """Number of tested pixels of the tile on whose surface no probe of the surrounding tiles lies."""
    pixel: wp.array[int]
    """Index of the pixel at which the tile's adaptive probe would be placed; -1: none needed."""
    source: wp.array[int]
    """Index of the previous frame's probe that the tile's adaptive probe would continue; -1: it would be new."""


@struct
class ProbePlacement:
    """Pixel chosen for the probe of a tile, and the probe that it continues."""

    pixel: int
    """Index of the chosen pixel; -1: no tested pixel is suitable."""
    source: int
    """Index of the previous frame's probe that the placed probe continues; -1: it is new."""
    uncovered: int
    """Number of tested pixels that are suitable; for an adaptive probe, those on no other probe's surface."""


@struct
class Match:
    """The previous frame's probe that lies on a pixel's surface and is nearest in the image."""

    probe: int
    """Index of the previous frame's probe; -1: none lies on the pixel's surface."""
    distance: float
    """Distance from pixel to probe in the image, pixels; adaptive probes may count as ``ADAPTIVE_PENALTY`` farther."""


SEARCH_ROWS = wp.constant(8)
"""The pixel for a probe is searched on a lattice of the tile's pixels with this number of rows and columns."""

COSINE_MIN_SPLATS = wp.constant(wp.float32(0.8))
"""Smallest cosine between the normals of a pixel and a probe on the same Gaussians; such normals are noisy."""

COSINE_MIN_MESHES = wp.constant(wp.float32(0.95))

SHARE_MIN = wp.constant(wp.float32(0.5))
"""A pixel gets a probe on a surface that covers less than this fraction of it only if the tile has no better pixel."""

LOW_COVERAGE_PENALTY = wp.constant(wp.float32(1e12))
"""Added to the cost of pixels that their surface covers by less than ``SHARE_MIN``: they are the last choice for a
probe."""

ADAPTIVE_PENALTY = wp.constant(wp.float32(1e6))
"""When a tile's own probe looks for the previous probe to continue, the distance of adaptive probes grows by this,
pixels.

The two probes of a tile then do not swap from frame to frame."""

CUT_OFF_STEPS = wp.constant(4)
"""The line from a pixel to a probe in the image is divided into this many steps; points between steps are tested for
occluders.
"""

OCCLUDER_DISTANCE_MAX = wp.constant(wp.float32(0.95))
"""A surface between pixel and probe in the image occludes the probe only if it is nearer to the eye than both.

Its distance from the eye must be below this fraction of the smaller of the pixel's and the probe's distance."""

DISTANCE_RATIO_MIN = wp.constant(wp.float32(0.85))
"""Two points share a probe only if the nearer one's distance from the eye is at least this fraction of the other's.

At grazing angles, the surface in a tile may be metres long."""

UNIT_32 = wp.constant(wp.float32(2.0**-32))


@wp.func
def reach_of(grid: ProbeGrid, camera: CameraData, distance: float) -> float:
    """Returns the width of a tile of pixels, in scene units, at a distance from the eye.

    Points may share a probe if they lie at most this far from a common plane.
    """
    width = float(grid.tile) / wp.min(camera.focal[0], camera.focal[1])
    if camera.model == ORTHOGRAPHIC:
        return width
    return width * distance


@wp.func
def fits(probes: ProbeData, i: int, position: wp.vec3, normal: wp.vec3, reach: float, extent: float) -> bool:
    """Returns whether probe ``i`` exists and lies on the surface of a point: near its plane, with a similar normal.

    ``reach`` is the largest distance from the plane, scene units; ``extent``, the largest scale of the point's
    Gaussian, replaces it if larger.
    """
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
    """Returns whether a nearer surface, such as a wall's end, lies between ``pixel`` and ``probe`` in the image."""
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
    """Returns the index of the tile in column ``x`` and row ``y`` of tiles; -1: outside the image."""
    if x < 0 or y < 0 or x >= grid.tiles_x or y >= grid.tiles_y:
        return -1
    return y * grid.tiles_x + x


@wp.func
def probe_of_tile(tile: int, adaptive: int, adaptive_of: wp.array[int]) -> int:
    """Returns the probe of a tile: its own for ``adaptive`` 0, its adaptive one for 1; -1: none."""
    if tile < 0 or adaptive == 0:
        return tile
    return adaptive_of[tile]


@wp.func
def radical_inverse_3(number: int) -> float:
    """Returns the radical inverse of ``number`` in base 3, 0..1: its ternary digits mirrored at the point."""
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
    """Returns the position within a tile, 0..1 along each side, at which a new probe is preferred in this frame.

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
    image = grid.before
    there = wp.cw_mul(image.scale, at) + image.shift
    size = image.size
    if not (there[0] >= 0.0 and there[1] >= 0.0 and there[0] < float(size[0]) and there[1] < float(size[1])):
        return match
    columns = (size[0] + grid.tile - 1) // grid.tile
    tile = (int(there[1]) // grid.tile) * columns + int(there[0]) // grid.tile
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
    """Returns whether the smaller of two distances from the eye exceeds ``DISTANCE_RATIO_MIN`` times the larger."""
    return wp.min(distance, other) > DISTANCE_RATIO_MIN * wp.max(distance, other)


@wp.func
def is_covered(grid: ProbeGrid, camera: CameraData, x: int, y: int, surfaces: SurfacePixels, probes: ProbeData) -> bool:
    """Returns whether one of the four tiles nearest to pixel (x, y) has its own probe on the pixel's surface.

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
    """Chooses the pixel of a tile for a probe: the one nearest to a previous frame's probe on the pixel's surface.

    If no such probe exists, it is the pixel nearest to ``wanted_pixel``. ``rows`` x ``rows`` pixels of the tile are
    tested; ``only_uncovered``: not those whose surface has a probe of this frame.
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
    """Chooses the pixel for a tile's own probe among a lattice of pixels; among all if the lattice shows no surface."""
    placement = choose_pixel_among(
        SEARCH_ROWS, tile, False, grid, camera, camera_before, surfaces, probes_before, probes_before, adaptive_before
    )
    if placement.pixel < 0:
        placement = choose_pixel_among(
            grid.tile, tile, False, grid, camera, camera_before, surfaces, probes_before, probes_before, adaptive_before
        )
    return placement
