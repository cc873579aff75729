"""What screen probes see, and what pixels see of them.

The method is in docs/method/realtime.md#screen-probes. Every kernel writes each element from one item only.
"""

import warp as wp

from lumisplat.constants.realtime import MEANS_CHUNK, PROBE_NORMALS
from lumisplat.device.gi.means import mean_weight
from lumisplat.device.gi.octahedral import cell_of_direction
from lumisplat.device.gi.probe_places import tile_of
from lumisplat.device.gi.probe_rays import neighbour_weight, refresh_key, shows_the_same, start_probe_ray
from lumisplat.device.gi.screen_probes import C0, COSINE_0, HARMONICS, gathered_light
from lumisplat.device.math.random import draw, sample_key_of
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import ProbeCells, ProbeData, ProbeGrid, ProbeLight, SurfacePixels
from lumisplat.device.structs.rays import RayData

wp.set_module_options({"enable_backward": False})


NORMALS = wp.constant(PROBE_NORMALS)
CHUNK = wp.constant(MEANS_CHUNK)
AROUND = wp.constant(2)
"""Pixels to each side that fill one without probes."""
JITTER_X = wp.constant(wp.uint32(0))
"""Dimensions of where a pixel looks probes up; its key has no others."""
JITTER_Y = wp.constant(wp.uint32(1))
LOOKUP_SEED = wp.constant(wp.uint32(0x6C6F6F6B))
"""Mixed into the seed: other numbers than those of rays."""


@wp.kernel
def rank_probes(
    start: int, grids: wp.array[ProbeGrid], probes: ProbeData, keys_out: wp.array[int], order_out: wp.array[int]
):
    """A key by which probes that need a refresh more come first."""
    i = start + wp.tid()
    keys_out[i] = refresh_key(i, grids[0], probes)
    order_out[i] = i


@wp.kernel
def start_probe_rays(
    start: int, grids: wp.array[ProbeGrid], order: wp.array[int], probes: ProbeData, rays_out: RayData
):
    """One ray a cell of the first probes in the order."""
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
    """Adds what a ray has seen to the means of its cell; a ray that saw something not finite counts as none."""
    ray = start + wp.tid()
    count = grids[0].cells * grids[0].cells
    cell = ray % count
    i = order[ray // count]
    if cell == 0 and probes_out.is_placed[i] != 0:
        probes_out.rounds[i] = probes_out.rounds[i] + 1
        probes_out.refreshed[i] = grids[0].frame
    if not rays.is_active[ray]:
        return
    seen = radiance[ray]
    if not (wp.isfinite(seen[0]) and wp.isfinite(seen[1]) and wp.isfinite(seen[2])):
        return
    k = i * count + cell
    samples = cells_out.samples[k]
    share = 1.0 / (mean_weight(samples, grids[0].history) + 1.0)
    cells_out.radiance[k] = cells_out.radiance[k] + share * (seen - cells_out.radiance[k])
    nearness = 1.0 / wp.max(hit_distance[ray], 1e-20)
    cells_out.nearness[k] = cells_out.nearness[k] + share * (nearness - cells_out.nearness[k])
    cells_out.samples[k] = wp.min(samples + 1.0, grids[0].history)


@wp.kernel
def outdate_cells(start: int, share: float, cells_inout: ProbeCells):
    """Item = cell: its means count for a share of what they did."""
    k = start + wp.tid()
    cells_inout.samples[k] = share * cells_inout.samples[k]


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
    """The mean of a cell over its probe, the other one of its tile, and those of the four tiles beside it."""
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
            if vote > 0.0 and shows_the_same(i, j, cell, grid, probes, cells):
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
    """Fills the cells of a probe that nothing is known of with the mean of the others, and finds its harmonics.

    Args:
        start: First item.
        grids: How the probes lie on the pixels.
        probes: The probes.
        fit: What each cell adds to the harmonics.
        beyond: What each cell adds to the irradiance besides, by the normal of the surface.
        weights: Of the cells; 0: nothing is known.
        light_inout: What the cells see; receives the harmonics.
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
    for h in range(HARMONICS):
        sum = wp.vec3(0.0)
        for cell in range(count):
            sum += fit[cell * HARMONICS + h] * light_inout.radiance[i * count + cell]
        light_inout.harmonics[HARMONICS * i + h] = sum
    missing = wp.vec3(0.0)
    row = cell_of_direction(probes.normal[i], NORMALS) * count
    for cell in range(count):
        missing += beyond[row + cell] * light_inout.radiance[i * count + cell]
    light_inout.harmonics[HARMONICS * i] += missing / (COSINE_0 * C0)


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
    """Irradiance of the surface of a pixel by the probes around it, where any says something."""
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
    """Sum of the irradiance over the pixels of a tile for which it is known, and their number."""
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
    """Item = chunk: the sum of the same over some of them."""
    chunk = start + wp.tid()
    total = wp.vec4(0.0)
    for i in range(chunk * CHUNK, wp.min((chunk + 1) * CHUNK, means.shape[0])):
        total += means[i]
    sums_out[chunk] = total


@wp.func
def known_around(x: int, y: int, grid: ProbeGrid, irradiance: wp.array[wp.vec3], is_known: wp.array[int]) -> wp.vec4:
    """Sum over the pixels around one for which irradiance is known, and their number."""
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
    """The same over the tile of a pixel and the eight around it."""
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
    """Irradiance of a pixel, where no probe says anything the mean of what is around it, the nearest first."""
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
