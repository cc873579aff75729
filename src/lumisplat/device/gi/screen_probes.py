"""Light of screen probes: irradiance and radiance at pixels, the probes' rays, and filtering between probes.

The equations are in docs/method/realtime.md#screen-probes.
"""

import math

import warp as wp

from lumisplat.constants import SH_C0
from lumisplat.device.gaussian.layers import above_layer
from lumisplat.device.gi.probe_placement import (
    ProbeCells,
    ProbeData,
    ProbeGrid,
    ProbeLight,
    fits,
    is_cut_off,
    probe_of_tile,
    reach_of,
    tile_of,
)
from lumisplat.device.gi.surfaces import SurfacePixels
from lumisplat.device.math.directions import cell_width, direction_in_cell, square_of_direction, wrapped_cell
from lumisplat.device.math.random import mix, pixel_key_of, sample_key_of, sobol_2d
from lumisplat.device.math.sh import C1, C2_XX, C2_XY, C2_ZZ
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.rays import RayData


@struct
class ProbeSum:
    """Sum over screen probes of weight times irradiance or radiance at a pixel, and sum of the weights."""

    total: wp.vec3
    weight: float


SH_COUNT = wp.constant(9)

C0 = wp.constant(wp.float32(SH_C0))

COSINE_0 = wp.constant(wp.float32(math.pi))
"""Factor of SH degree 0 when radiance is convolved to irradiance (Ramamoorthi and Hanrahan 2001)."""

COSINE_1 = wp.constant(wp.float32(2.0 * math.pi / 3.0))

COSINE_2 = wp.constant(wp.float32(math.pi / 4.0))

DISTANCE2_MIN = wp.constant(wp.float32(0.05))
"""A probe's weight is divided by its squared distance from the pixel, in tile widths, plus this value.

It limits the weight of probes close to the pixel."""

CUT_OFF_WEIGHT = wp.constant(wp.float32(1e-3))
"""The weight of a probe that is occluded from the pixel is multiplied by this, so that others prevail if there are
any."""

WEIGHT_MIN = wp.constant(wp.float32(1e-6))
"""If the weights of the probes around a pixel sum to less than this, the probes are ignored."""


@wp.func
def probe_irradiance(light: ProbeLight, i: int, normal: wp.vec3) -> wp.vec3:
    """Returns the irradiance at probe ``i`` of a surface with this normal, from SH up to degree 2.

    It may be slightly negative.
    """
    x = normal[0]
    y = normal[1]
    z = normal[2]
    first = SH_COUNT * i
    sum = (COSINE_0 * C0) * light.sh[first]
    sum += (COSINE_1 * C1) * (z * light.sh[first + 2] - y * light.sh[first + 1])
    sum -= (COSINE_1 * C1 * x) * light.sh[first + 3]
    sum += (COSINE_2 * C2_XY * x) * (y * light.sh[first + 4] - z * light.sh[first + 7])
    sum -= (COSINE_2 * C2_XY * y * z) * light.sh[first + 5]
    sum += (COSINE_2 * C2_ZZ * (3.0 * z * z - 1.0)) * light.sh[first + 6]
    sum += (COSINE_2 * C2_XX * (x * x - y * y)) * light.sh[first + 8]
    return sum


@wp.func
def probe_radiance(light: ProbeLight, i: int, cells: int, direction: wp.vec3) -> wp.vec3:
    """Returns the radiance that arrives at probe ``i`` from a unit direction, bilinear between its map cells.

    ``cells`` is the number of cells along a side of the octahedral map.
    """
    point = square_of_direction(direction) * float(cells) - wp.vec2(0.5, 0.5)
    left = wp.floor(point[0])
    above = wp.floor(point[1])
    right_share = point[0] - left
    below_share = point[1] - above
    x = int(left)
    y = int(above)
    first = i * cells * cells
    upper = (1.0 - right_share) * light.radiance[first + wrapped_cell(x, y, cells)]
    upper += right_share * light.radiance[first + wrapped_cell(x + 1, y, cells)]
    lower = (1.0 - right_share) * light.radiance[first + wrapped_cell(x, y + 1, cells)]
    lower += right_share * light.radiance[first + wrapped_cell(x + 1, y + 1, cells)]
    return (1.0 - below_share) * upper + below_share * lower


@wp.func
def nearness_weight(distance: float, other: float) -> float:
    """Returns ``(smaller / larger)^8`` of two distances from the eye: 1 if they are equal."""
    ratio = wp.min(distance, other) / wp.max(wp.max(distance, other), 1e-20)
    ratio *= ratio
    ratio *= ratio
    return ratio * ratio


@wp.func
def facing_weight(normal: wp.vec3, other: wp.vec3) -> float:
    """Returns ``max(cosine, 0)^8`` of the angle between two normals: 1 if they are equal."""
    cosine = wp.max(wp.dot(normal, other), 0.0)
    cosine *= cosine
    cosine *= cosine
    return cosine * cosine


@wp.func
def add_probe(
    probe_sum: ProbeSum, weight: float, i: int, cells: int, direction: wp.vec3, glossy: bool, light: ProbeLight
):
    """Returns ``probe_sum`` with the light of probe ``i``, times ``weight``, added.

    The light is the radiance from ``direction`` if ``glossy``, else the irradiance for the normal ``direction``.
    """
    if glossy:
        probe_sum.total += weight * probe_radiance(light, i, cells, direction)
    else:
        probe_sum.total += weight * probe_irradiance(light, i, direction)
    probe_sum.weight += weight
    return probe_sum


@wp.func
def near_probes(
    pixel: int,
    point: wp.vec2,
    direction: wp.vec3,
    glossy: bool,
    grid: ProbeGrid,
    camera: CameraData,
    surfaces: SurfacePixels,
    probes: ProbeData,
    adaptive_of: wp.array[int],
    light: ProbeLight,
) -> ProbeSum:
    """Sums the light of the probes on the surface of ``pixel`` in the four tiles nearest to image position ``point``.

    The light is the radiance from ``direction`` if ``glossy``, else the irradiance for the normal ``direction``.
    """
    probe_sum = ProbeSum()
    normal = surfaces.normal[pixel]
    distance = surfaces.distance[pixel]
    reach = reach_of(grid, camera, distance)
    across = point[0] / float(grid.tile) - 0.5
    down = point[1] / float(grid.tile) - 0.5
    for k in range(4):
        x = int(wp.floor(across)) + k % 2
        y = int(wp.floor(down)) + k // 2
        tile = tile_of(grid, x, y)
        for adaptive in range(2):
            i = probe_of_tile(tile, adaptive, adaptive_of)
            if fits(probes, i, surfaces.position[pixel], normal, reach, surfaces.extent[pixel]):
                if light.exists[i] != 0 and not is_cut_off(pixel, i, grid, surfaces, probes):
                    apart = (probes.pixel[i] - point) / float(grid.tile)
                    weight = nearness_weight(distance, probes.distance[i]) / (wp.length_sq(apart) + DISTANCE2_MIN)
                    weight *= facing_weight(normal, probes.normal[i])
                    probe_sum = add_probe(probe_sum, weight, i, grid.cells, direction, glossy, light)
    return probe_sum


@wp.func
def wider_probes(
    pixel: int,
    direction: wp.vec3,
    glossy: bool,
    grid: ProbeGrid,
    surfaces: SurfacePixels,
    probes: ProbeData,
    adaptive_of: wp.array[int],
    light: ProbeLight,
) -> ProbeSum:
    """Sums the light of all probes in the tile of ``pixel`` and the eight tiles around it that face the pixel's side.

    The probes need not lie on the pixel's surface. The light is the radiance from ``direction`` if ``glossy``, else the
    irradiance for the normal ``direction``.
    """
    probe_sum = ProbeSum()
    normal = surfaces.normal[pixel]
    column = pixel % grid.width // grid.tile
    row = pixel // grid.width // grid.tile
    for k in range(9):
        tile = tile_of(grid, column + k % 3 - 1, row + k // 3 - 1)
        for adaptive in range(2):
            i = probe_of_tile(tile, adaptive, adaptive_of)
            if i >= 0:
                if probes.is_placed[i] != 0 and light.exists[i] != 0:
                    weight = nearness_weight(surfaces.distance[pixel], probes.distance[i])
                    weight *= wp.max(wp.dot(normal, probes.normal[i]), 0.0)
                    if is_cut_off(pixel, i, grid, surfaces, probes):
                        weight *= CUT_OFF_WEIGHT
                    probe_sum = add_probe(probe_sum, weight, i, grid.cells, direction, glossy, light)
    return probe_sum


@wp.func
def gathered_light(
    pixel: int,
    point: wp.vec2,
    direction: wp.vec3,
    glossy: bool,
    grid: ProbeGrid,
    camera: CameraData,
    surfaces: SurfacePixels,
    probes: ProbeData,
    adaptive_of: wp.array[int],
    light: ProbeLight,
) -> ProbeSum:
    """Returns the weighted mean light of probes around a pixel: those on its surface or, without any, all around.

    A weight of 0 means that there are no probes. ``point`` is the image position, pixels, around which tiles are looked
    up: in the pixel, or jittered by up to half a tile. The light is the radiance from ``direction`` if ``glossy``, else
    the irradiance for the normal ``direction``.
    """
    probe_sum = near_probes(pixel, point, direction, glossy, grid, camera, surfaces, probes, adaptive_of, light)
    if not probe_sum.weight > WEIGHT_MIN:
        probe_sum = wider_probes(pixel, direction, glossy, grid, surfaces, probes, adaptive_of, light)
    if not probe_sum.weight > WEIGHT_MIN:
        return ProbeSum()
    probe_sum.total = wp.max(probe_sum.total / probe_sum.weight, wp.vec3(0.0))
    return probe_sum


# --- Rays of probes, and filtering between neighbouring probes ---

RISE = wp.constant(wp.float32(1e-4))
"""Height above a mesh at which probe rays start, as a fraction of a length.

The length is the largest coordinate of the probe or its distance from the eye, whichever is larger.
"""

NEVER = wp.constant(2**31 - 1)

STALEST = wp.constant(1 << 20)
"""Refresh priority grows with the number of frames since a probe was refreshed, up to this number."""

BAYER = wp.constant(wp.types.vector(length=16, dtype=wp.int32)(0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5))
"""Order in which the probes of 4 x 4 tiles are refreshed; any first n of them are spread evenly."""

ANGLE_MAX = wp.constant(wp.float32(0.2))
"""Largest angle, in cell widths, at which the map cells of two probes are averaged.

Seen from one probe, it is the angle between the cell's direction and the point that the other probe's cell hit."""

PROBE_SEED = wp.constant(wp.uint32(0x70726F62))
"""Mixed into the random seed for probe rays, so that they use other numbers than camera rays."""


@wp.func
def refresh_key(i: int, grid: ProbeGrid, probes: ProbeData) -> int:
    """Returns the sort key by which probes are refreshed, lowest first: new probes, then those refreshed longest ago.

    Probes of equal age are spread over the image.
    """
    if probes.is_placed[i] == 0:
        return NEVER
    tile = i % (grid.tiles_x * grid.tiles_y)
    turn = BAYER[tile // grid.tiles_x % 4 * 4 + tile % grid.tiles_x % 4]
    if probes.refresh_count[i] == 0:
        return turn
    return 16 * (STALEST + 1 - wp.clamp(grid.frame - probes.refreshed[i], 0, STALEST)) + turn


@wp.func
def start_probe_ray(ray: int, i: int, cell: int, grid: ProbeGrid, probes: ProbeData, rays_out: RayData):
    """Writes ray ``ray`` of probe ``i`` in a random direction within cell ``cell`` of its map.

    A ray that would enter the surface that the probe lies on stays inactive.
    """
    seed = wp.bit_xor(grid.seed, PROBE_SEED)
    number = i * grid.cells * grid.cells + cell
    key = pixel_key_of(number, seed)
    sample = probes.refresh_count[i]
    direction = direction_in_cell(cell, grid.cells, sobol_2d(key, sample))
    normal = probes.normal[i]
    position = probes.position[i]
    extent = probes.extent[i]
    if wp.dot(direction, normal) <= 0.0:
        return
    if extent == 0.0:
        position += RISE * wp.max(wp.max(wp.abs(position)), probes.distance[i]) * normal
    rays_out.is_active[ray] = True
    rays_out.origin[ray] = above_layer(position, normal, grid.offset * extent)
    rays_out.direction[ray] = direction
    rays_out.t_min[ray] = grid.offset * extent
    rays_out.normal[ray] = normal
    rays_out.t_max[ray] = wp.inf
    rays_out.path_length[ray] = 0.0
    rays_out.spread[ray] = 0.0
    rays_out.sample_key[ray] = mix(sample_key_of(number, grid.frame, seed))
    rays_out.pixel_key[ray] = key
    rays_out.sample[ray] = sample


@wp.func
def neighbour_weight(i: int, j: int, grid: ProbeGrid, camera: CameraData, probes: ProbeData) -> float:
    """Returns the weight of probe ``j`` when the light of probe ``i`` is filtered; 0 if their surfaces differ."""
    reach = reach_of(grid, camera, probes.distance[i])
    if not fits(probes, j, probes.position[i], probes.normal[i], reach, probes.extent[i]):
        return float(0.0)
    return nearness_weight(probes.distance[i], probes.distance[j])


@wp.func
def shows_same_surface(i: int, j: int, cell: int, grid: ProbeGrid, probes: ProbeData, cells: ProbeCells) -> bool:
    """Returns whether map cell ``cell`` shows the same surface from probe ``i`` as from probe ``j``.

    Seen from ``i``, the point that the cell of ``j`` hits must lie in the cell's direction. The hit distance from ``j``
    is limited to the hit distance from ``i``, so that near surfaces are not blurred with the surfaces behind them. If
    the cell of ``i`` has no samples, the result is True.
    """
    count = grid.cells * grid.cells
    if cells.samples[i * count + cell] == 0.0:
        return True
    nearness = wp.max(cells.nearness[j * count + cell], cells.nearness[i * count + cell])
    direction = direction_in_cell(cell, grid.cells, wp.vec2(0.5, 0.5))
    to_hit = direction + nearness * (probes.position[j] - probes.position[i])
    return wp.dot(direction, wp.normalize(to_hit)) > wp.cos(ANGLE_MAX * cell_width(grid.cells))
