"""Kernels of screen probes: they place one probe per tile plus adaptive probes, and gather light at probes.

A tile is a square of pixels. The method is in docs/method/realtime.md#screen-probes. Each array element has one writer.
"""

import warp as wp

from lumisplat.constants import MEANS_CHUNK, PROBE_NORMALS
from lumisplat.device.camera.camera import pixel_of_point
from lumisplat.device.gi.probe_placement import (
    SEARCH_ROWS,
    ProbeCells,
    ProbeData,
    ProbeGrid,
    ProbeLight,
    TileNeeds,
    choose_pixel_among,
    choose_pixel_in_tile,
    tile_of,
)
from lumisplat.device.gi.screen_probes import (
    C0,
    COSINE_0,
    SH_COUNT,
    gathered_light,
    neighbour_weight,
    refresh_key,
    shows_same_surface,
    start_probe_ray,
)
from lumisplat.device.gi.surfaces import SequenceData, SurfacePixels, mean_weight
from lumisplat.device.math.directions import cell_of_direction, cell_width, direction_in_cell
from lumisplat.device.math.random import draw, sample_key_of
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.rays import RayData

wp.set_module_options({"enable_backward": False})

PROBE_STAYS_PX = 2.0
"""Largest distance in the image, pixels, between a probe and the pixel of its tile that shows its surface in the next
frame; up to this distance, the probe keeps its position."""

STAYS_PX = wp.constant(wp.float32(PROBE_STAYS_PX))

ABRUPT = wp.constant(wp.float32(0.5))
"""Below this weight of cached lighting, light has changed abruptly."""


@wp.func
def is_as_before(
    pixel: int, source: int, grid: ProbeGrid, camera: CameraData, surfaces: SurfacePixels, before: ProbeData
) -> bool:
    """Returns whether a probe may stay where probe ``source`` was in the previous frame.

    The surface of ``pixel`` must not have moved, and the old position must be within `PROBE_STAYS_PX` of that pixel. A
    probe that followed the jitter of samples would lose the radiance of near surfaces.
    """
    if not wp.length(surfaces.previous[pixel] - surfaces.position[pixel]) == 0.0:  # NaN: the surface is new
        return False
    center = wp.vec2(float(pixel % grid.width) + 0.5, float(pixel // grid.width) + 0.5)
    return wp.length(pixel_of_point(camera, before.position[source]) - center) < STAYS_PX


@wp.func
def set_probe(
    i: int,
    pixel: int,
    source: int,
    grid: ProbeGrid,
    camera: CameraData,
    surfaces: SurfacePixels,
    before: ProbeData,
    probes_out: ProbeData,
):
    """Places probe ``i`` on the surface of ``pixel``; if that is -1, the probe is unused.

    If the surface is still the one of probe ``source`` of the previous frame, the probe stays at that probe's position.
    """
    probes_out.is_placed[i] = 0
    probes_out.source[i] = -1
    probes_out.refresh_count[i] = 0
    if pixel < 0:
        return
    probes_out.is_placed[i] = 1
    probes_out.position[i] = surfaces.position[pixel]
    probes_out.pixel[i] = wp.vec2(float(pixel % grid.width) + 0.5, float(pixel // grid.width) + 0.5)
    probes_out.normal[i] = surfaces.normal[pixel]
    probes_out.distance[i] = surfaces.distance[pixel]
    probes_out.extent[i] = surfaces.extent[pixel]
    if source >= 0:
        probes_out.source[i] = source
        if is_as_before(pixel, source, grid, camera, surfaces, before):
            probes_out.position[i] = before.position[source]
            probes_out.normal[i] = before.normal[source]
            probes_out.extent[i] = before.extent[source]
            probes_out.distance[i] = wp.length(before.position[source] - camera.eye)
        probes_out.refresh_count[i] = before.refresh_count[source]
        probes_out.refreshed[i] = before.refreshed[source]


@wp.kernel
def place_in_tiles(
    start: int,
    grids: wp.array[ProbeGrid],
    cameras: wp.array[CameraData],
    cameras_before: wp.array[CameraData],
    surfaces: SurfacePixels,
    before: ProbeData,
    adaptive_before: wp.array[int],
    probes_out: ProbeData,
):
    """Per tile (square of pixels): places its regular probe on the surface of one of its pixels."""
    tile = start + wp.tid()
    place = choose_pixel_in_tile(tile, grids[0], cameras[0], cameras_before[0], surfaces, before, adaptive_before)
    set_probe(tile, place.pixel, place.source, grids[0], cameras[0], surfaces, before, probes_out)


@wp.kernel
def find_needs(
    start: int,
    grids: wp.array[ProbeGrid],
    cameras: wp.array[CameraData],
    cameras_before: wp.array[CameraData],
    surfaces: SurfacePixels,
    probes: ProbeData,
    before: ProbeData,
    adaptive_before: wp.array[int],
    needs_out: TileNeeds,
    keys_out: wp.array[int],
    order_out: wp.array[int],
):
    """Per tile: counts the pixels that no probe is near enough to, and writes a sort key, largest count first."""
    tile = start + wp.tid()
    place = choose_pixel_among(
        SEARCH_ROWS, tile, True, grids[0], cameras[0], cameras_before[0], surfaces, probes, before, adaptive_before
    )
    needs_out.uncovered[tile] = place.uncovered
    needs_out.pixel[tile] = place.pixel
    needs_out.source[tile] = place.source
    keys_out[tile] = grids[0].tile * grids[0].tile - place.uncovered
    order_out[tile] = tile


@wp.kernel
def place_adaptive(
    start: int,
    grids: wp.array[ProbeGrid],
    cameras: wp.array[CameraData],
    order: wp.array[int],
    needs: TileNeeds,
    surfaces: SurfacePixels,
    before: ProbeData,
    adaptive_of_out: wp.array[int],
    probes_out: ProbeData,
):
    """Per tile, in sorted order: places an adaptive probe if pixels of the tile need one and there are free probes."""
    rank = start + wp.tid()
    tile = order[rank]
    adaptive_of_out[tile] = -1
    if rank < grids[0].adaptive:
        i = grids[0].tiles_x * grids[0].tiles_y + rank
        pixel = wp.where(needs.uncovered[tile] > 0, needs.pixel[tile], -1)
        set_probe(i, pixel, needs.source[tile], grids[0], cameras[0], surfaces, before, probes_out)
        if pixel >= 0:
            adaptive_of_out[tile] = i


@wp.kernel
def carry_cells(
    start: int,
    grids: wp.array[ProbeGrid],
    probes: ProbeData,
    before: ProbeData,
    cells_before: ProbeCells,
    cells_out: ProbeCells,
):
    """Per probe: copies the cells (directions) of its predecessor in the previous frame, reprojected to its position.

    A cell keeps its direction if its hit is nearer than the distance by which the probe has moved.
    """
    i = start + wp.tid()
    side = grids[0].cells
    count = side * side
    for cell in range(count):
        cells_out.radiance[i * count + cell] = wp.vec3(0.0)
        cells_out.nearness[i * count + cell] = 0.0
        cells_out.samples[i * count + cell] = 0.0
    if probes.is_placed[i] == 0:
        return
    source = probes.source[i]
    if source < 0:
        return
    move = before.position[source] - probes.position[i]
    for cell in range(count):
        from_cell = source * count + cell
        samples = cells_before.samples[from_cell]
        if samples > 0.0:
            nearness = cells_before.nearness[from_cell]
            direction = direction_in_cell(cell, side, wp.vec2(0.5, 0.5))
            to_cell = i * count + cell
            if nearness * wp.length(move) < 1.0:
                moved = direction + nearness * move
                stretch = wp.length(moved)
                if stretch > 0.0:
                    nearness /= stretch
                    direction = moved / stretch
                    to_cell = i * count + cell_of_direction(direction, side)
            # Cells below the horizon get no rays and would never be renewed.
            if wp.dot(direction, probes.normal[i]) < -cell_width(side):
                samples = 0.0
            cells_out.radiance[to_cell] = cells_out.radiance[to_cell] + samples * cells_before.radiance[from_cell]
            cells_out.nearness[to_cell] = cells_out.nearness[to_cell] + samples * nearness
            cells_out.samples[to_cell] = cells_out.samples[to_cell] + samples
    for cell in range(count):
        k = i * count + cell
        samples = cells_out.samples[k]
        if samples > 0.0:
            cells_out.radiance[k] = cells_out.radiance[k] / samples
            cells_out.nearness[k] = cells_out.nearness[k] / samples
            cells_out.samples[k] = wp.min(samples, grids[0].history)


NORMALS = wp.constant(PROBE_NORMALS)
CHUNK = wp.constant(MEANS_CHUNK)
AROUND = wp.constant(2)
"""A pixel without light from probes gets the mean irradiance of the pixels around it, up to this many pixels away
along each axis."""
JITTER_X = wp.constant(wp.uint32(0))
"""Dimensions of two random numbers, which jitter the position at which a pixel looks up probes."""
JITTER_Y = wp.constant(wp.uint32(1))
LOOKUP_SEED = wp.constant(wp.uint32(0x6C6F6F6B))
"""Number mixed into the random seed of pixels' look-ups, so that their seed differs from that of the probes' rays."""


@wp.kernel
def rank_probes(
    start: int, grids: wp.array[ProbeGrid], probes: ProbeData, keys_out: wp.array[int], order_out: wp.array[int]
):
    """Per probe: writes a sort key that puts new probes first, then those whose rays were traced longest ago."""
    i = start + wp.tid()
    keys_out[i] = refresh_key(i, grids[0], probes)
    order_out[i] = i


@wp.kernel
def start_probe_rays(
    start: int, grids: wp.array[ProbeGrid], order: wp.array[int], probes: ProbeData, rays_out: RayData
):
    """Per ray: starts the ray. There is one ray for each cell (direction) of the first probes in sorted order."""
    ray = start + wp.tid()
    count = grids[0].cells * grids[0].cells
    i = order[ray // count]
    rays_out.is_active[ray] = False
    if probes.is_placed[i] != 0:
        start_probe_ray(ray, i, ray % count, grids[0], probes, rays_out)


@wp.kernel
def add_samples(
    start: int,
    grids: wp.array[ProbeGrid],
    order: wp.array[int],
    rays: RayData,
    radiance: wp.array[wp.vec3],
    hit_distance: wp.array[float],
    probes_out: ProbeData,
    cells_out: ProbeCells,
):
    """Per ray: adds the ray's radiance to the mean of its probe's cell, unless the radiance is not finite."""
    ray = start + wp.tid()
    count = grids[0].cells * grids[0].cells
    cell = ray % count
    i = order[ray // count]
    if cell == 0 and probes_out.is_placed[i] != 0:
        probes_out.refresh_count[i] = probes_out.refresh_count[i] + 1
        probes_out.refreshed[i] = grids[0].frame
    k = i * count + cell
    samples = cells_out.samples[k]
    if not rays.is_active[ray]:
        # At the horizon, light from before a change would stay until a ray happens to start above the surface.
        if samples < 1.0:
            cells_out.samples[k] = 0.0
        return
    color = radiance[ray]
    if not (wp.isfinite(color[0]) and wp.isfinite(color[1]) and wp.isfinite(color[2])):
        return
    share = 1.0 / (mean_weight(samples, grids[0].history) + 1.0)
    cells_out.radiance[k] = cells_out.radiance[k] + share * (color - cells_out.radiance[k])
    nearness = 1.0 / wp.max(hit_distance[ray], 1e-20)
    cells_out.nearness[k] = cells_out.nearness[k] + share * (nearness - cells_out.nearness[k])
    cells_out.samples[k] = wp.min(samples + 1.0, grids[0].history)


@wp.kernel
def outdate_cells(start: int, sequence: wp.array[SequenceData], cells_inout: ProbeCells):
    """Per probe cell (direction): multiplies the weight of its mean radiance by the root of that of cached lighting.

    The means have few samples, and what they sample is averaged over frames already. An abrupt change counts fully.
    """
    k = start + wp.tid()
    weight = sequence[0].history_weight
    if weight < 1.0:
        cells_inout.samples[k] = wp.where(weight < ABRUPT, weight, wp.sqrt(weight)) * cells_inout.samples[k]


@wp.kernel
def filter_cells(
    start: int,
    grids: wp.array[ProbeGrid],
    cameras: wp.array[CameraData],
    probes: ProbeData,
    adaptive_of: wp.array[int],
    tile_of_adaptive: wp.array[int],
    cells: ProbeCells,
    light_out: ProbeLight,
    weights_out: wp.array[float],
):
    """Per probe cell (direction): averages radiance over its probe and the probes around.

    These are the other probe of the same tile, and the regular probes of the four adjacent tiles.
    """
    k = start + wp.tid()
    grid = grids[0]
    count = grid.cells * grid.cells
    i = k // count
    cell = k - i * count
    light_out.radiance[k] = wp.vec3(0.0)
    weights_out[k] = 0.0
    if probes.is_placed[i] == 0:
        return
    tiles = grid.tiles_x * grid.tiles_y
    tile = i
    partner = int(-1)
    if i < tiles:
        partner = adaptive_of[i]
    else:
        tile = tile_of_adaptive[i - tiles]
        partner = tile
    column = tile % grid.tiles_x
    row = tile // grid.tiles_x
    total = cells.samples[k] * cells.radiance[k]
    weight = cells.samples[k]
    for beside in range(5):
        j = partner
        if beside > 0:
            along = 2 * (beside % 2) - 1
            down = beside // 3
            j = tile_of(grid, column + along * (1 - down), row + along * down)
        if j >= 0 and cells.samples[wp.max(j, 0) * count + cell] > 0.0:
            vote = neighbour_weight(i, j, grid, cameras[0], probes)
            if vote > 0.0 and shows_same_surface(i, j, cell, grid, probes, cells):
                vote *= cells.samples[j * count + cell]
                total += vote * cells.radiance[j * count + cell]
                weight += vote
    if weight > 0.0:
        light_out.radiance[k] = total / weight
    weights_out[k] = weight


@wp.kernel
def project_probes(
    start: int,
    grids: wp.array[ProbeGrid],
    probes: ProbeData,
    fit: wp.array[float],
    beyond: wp.array[float],
    weights: wp.array[float],
    light_inout: ProbeLight,
):
    """Per probe: fills the probe's empty cells with the mean of its other cells, and projects all cells to SH.

    Args:
        start: Offset added to the thread index.
        grids: Layout of the probes.
        probes: The probes.
        fit: Contribution of each cell to the SH coefficients.
        beyond: By surface normal, the contribution of each cell to the irradiance that the SH degree cannot represent.
        weights: Weights of the cells; 0: empty.
        light_inout: Radiance of the cells; receives the SH coefficients.
    """
    i = start + wp.tid()
    count = grids[0].cells * grids[0].cells
    total = wp.vec3(0.0)
    filled = float(0.0)
    for cell in range(count):
        if weights[i * count + cell] > 0.0:
            total += light_inout.radiance[i * count + cell]
            filled += 1.0
    light_inout.exists[i] = 0
    if filled == 0.0:
        return
    light_inout.exists[i] = 1
    mean = total / filled
    for cell in range(count):
        if not weights[i * count + cell] > 0.0:
            light_inout.radiance[i * count + cell] = mean
    for h in range(SH_COUNT):
        sum = wp.vec3(0.0)
        for cell in range(count):
            sum += fit[cell * SH_COUNT + h] * light_inout.radiance[i * count + cell]
        light_inout.sh[SH_COUNT * i + h] = sum
    missing = wp.vec3(0.0)
    row = cell_of_direction(probes.normal[i], NORMALS) * count
    for cell in range(count):
        missing += beyond[row + cell] * light_inout.radiance[i * count + cell]
    light_inout.sh[SH_COUNT * i] += missing / (COSINE_0 * C0)


@wp.kernel
def find_irradiance(
    start: int,
    grids: wp.array[ProbeGrid],
    cameras: wp.array[CameraData],
    surfaces: SurfacePixels,
    probes: ProbeData,
    adaptive_of: wp.array[int],
    light: ProbeLight,
    irradiance_out: wp.array[wp.vec3],
    is_known_out: wp.array[int],
):
    """Per pixel: computes the irradiance on the pixel's surface from the probes around, if any of them has light."""
    pixel = start + wp.tid()
    grid = grids[0]
    irradiance_out[pixel] = wp.vec3(0.0)
    is_known_out[pixel] = 0
    if not surfaces.share[pixel] > 0.0:
        return
    key = sample_key_of(pixel, grid.frame, wp.bit_xor(grid.seed, LOOKUP_SEED))
    x = float(pixel % grid.width) + 0.5 + (draw(key, JITTER_X) - 0.5) * float(grid.tile)
    y = float(pixel // grid.width) + 0.5 + (draw(key, JITTER_Y) - 0.5) * float(grid.tile)
    normal = surfaces.normal[pixel]
    found = gathered_light(pixel, wp.vec2(x, y), normal, False, grid, cameras[0], surfaces, probes, adaptive_of, light)
    if found.weight > 0.0:
        irradiance_out[pixel] = found.total
        is_known_out[pixel] = 1


@wp.kernel
def tile_means(
    start: int,
    grids: wp.array[ProbeGrid],
    irradiance: wp.array[wp.vec3],
    is_known: wp.array[int],
    means_out: wp.array[wp.vec4],
):
    """Per tile: writes (sum of irradiance, count) over its pixels whose irradiance is known (``is_known``)."""
    tile = start + wp.tid()
    grid = grids[0]
    total = wp.vec4(0.0)
    for k in range(grid.tile * grid.tile):
        x = tile % grid.tiles_x * grid.tile + k % grid.tile
        y = tile // grid.tiles_x * grid.tile + k // grid.tile
        if x < grid.width and y < grid.height:
            pixel = y * grid.width + x
            if is_known[pixel] != 0:
                here = irradiance[pixel]
                total += wp.vec4(here[0], here[1], here[2], 1.0)
    means_out[tile] = total


@wp.kernel
def add_means(start: int, means: wp.array[wp.vec4], sums_out: wp.array[wp.vec4]):
    """Per chunk (range of tiles): adds up the sums and counts of irradiance that `tile_means` wrote."""
    chunk = start + wp.tid()
    total = wp.vec4(0.0)
    for i in range(chunk * CHUNK, wp.min((chunk + 1) * CHUNK, means.shape[0])):
        total += means[i]
    sums_out[chunk] = total


@wp.func
def known_around(x: int, y: int, grid: ProbeGrid, irradiance: wp.array[wp.vec3], is_known: wp.array[int]) -> wp.vec4:
    """Returns (sum of irradiance, count) of those of the 5 x 5 pixels around (x, y) whose irradiance is known."""
    total = wp.vec4(0.0)
    for v in range(wp.max(y - AROUND, 0), wp.min(y + AROUND + 1, grid.height)):
        for u in range(wp.max(x - AROUND, 0), wp.min(x + AROUND + 1, grid.width)):
            pixel = v * grid.width + u
            if is_known[pixel] != 0:
                here = irradiance[pixel]
                total += wp.vec4(here[0], here[1], here[2], 1.0)
    return total


@wp.func
def tiles_around(x: int, y: int, grid: ProbeGrid, means: wp.array[wp.vec4]) -> wp.vec4:
    """Returns (sum of irradiance, count) over a pixel's tile and the eight adjacent tiles, from `tile_means`."""
    total = wp.vec4(0.0)
    for k in range(9):
        tile = tile_of(grid, x // grid.tile + k % 3 - 1, y // grid.tile + k // 3 - 1)
        if tile >= 0:
            total += means[tile]
    return total


@wp.kernel
def fill_pixels(
    start: int,
    grids: wp.array[ProbeGrid],
    surfaces: SurfacePixels,
    irradiance: wp.array[wp.vec3],
    is_known: wp.array[int],
    means: wp.array[wp.vec4],
    mean: wp.array[wp.vec4],
    irradiance_out: wp.array[wp.vec3],
):
    """Per pixel: writes the irradiance; if no probe nearby has light, the mean of the nearest pixels with light."""
    pixel = start + wp.tid()
    irradiance_out[pixel] = irradiance[pixel]
    if is_known[pixel] != 0 or not surfaces.share[pixel] > 0.0:
        return
    x = pixel % grids[0].width
    y = pixel // grids[0].width
    total = known_around(x, y, grids[0], irradiance, is_known)
    if total[3] == 0.0:
        total = tiles_around(x, y, grids[0], means)
    if total[3] == 0.0:
        total = mean[0]
    if total[3] > 0.0:
        irradiance_out[pixel] = wp.vec3(total[0], total[1], total[2]) / total[3]
