"""Rays of screen probes, and how the cells of neighbouring probes agree (docs/method/realtime.md#screen-probes)."""

import warp as wp

from lumisplat.device.gaussian.layers import above_layer
from lumisplat.device.gi.octahedral import cell_width, direction_in_cell
from lumisplat.device.gi.probe_places import fits, reach_of
from lumisplat.device.gi.screen_probes import nearness_weight
from lumisplat.device.math.random import mix, pixel_key_of, sample_key_of, sobol_2d
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import ProbeCells, ProbeData, ProbeGrid
from lumisplat.device.structs.rays import RayData

wp.set_module_options({"enable_backward": False})

RISE = wp.constant(wp.float32(1e-4))
"""How far above a mesh rays begin, as a share of the largest of its coordinates and its distance from the eye."""
NEVER = wp.constant(2**31 - 1)
STALEST = wp.constant(1 << 20)
"""Frames after which a probe's age no longer counts."""
BAYER = wp.constant(wp.types.vector(length=16, dtype=wp.int32)(0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5))
"""Order of the tiles of a block of 4 x 4 in which any few are spread evenly."""
ANGLE_MAX = wp.constant(wp.float32(0.2))
"""Largest angle between the directions in which two probes see what a cell shows, as a share of a cell's width."""
PROBE_SEED = wp.constant(wp.uint32(0x70726F62))
"""Mixed into the seed: other numbers than those of camera rays."""


@wp.func
def refresh_key(i: int, grid: ProbeGrid, probes: ProbeData) -> int:
    """Probes with lower keys are refreshed sooner: those that never were, then the oldest, some of each region."""
    if probes.is_placed[i] == 0:
        return NEVER
    tile = i % (grid.tiles_x * grid.tiles_y)
    turn = BAYER[tile // grid.tiles_x % 4 * 4 + tile % grid.tiles_x % 4]
    if probes.rounds[i] == 0:
        return turn
    return 16 * (STALEST + 1 - wp.clamp(grid.frame - probes.refreshed[i], 0, STALEST)) + turn


@wp.func
def start_probe_ray(ray: int, i: int, cell: int, grid: ProbeGrid, probes: ProbeData, rays_out: RayData):
    """The ray of a cell of probe ``i``, through a point that is uniform in the cell; none into a mesh itself."""
    seed = wp.bit_xor(grid.seed, PROBE_SEED)
    number = i * grid.cells * grid.cells + cell
    key = pixel_key_of(number, seed)
    sample = probes.rounds[i]
    direction = direction_in_cell(cell, grid.cells, sobol_2d(key, sample))
    normal = probes.normal[i]
    position = probes.position[i]
    extent = probes.extent[i]
    if extent == 0.0:
        if wp.dot(direction, normal) <= 0.0:
            return
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
    """How much probe ``j`` counts for probe ``i``: 0 off its plane."""
    reach = reach_of(grid, camera, probes.distance[i])
    if not fits(probes, j, probes.position[i], probes.normal[i], reach, probes.extent[i]):
        return float(0.0)
    return nearness_weight(probes.distance[i], probes.distance[j])


@wp.func
def shows_the_same(i: int, j: int, cell: int, grid: ProbeGrid, probes: ProbeData, cells: ProbeCells) -> bool:
    """Whether a cell of two probes shows the same: the hit of ``j``, no further than that of ``i``, seen from ``i``.

    So nothing that ``i`` sees near is blurred with what is behind it; what ``i`` has not seen yet is taken as it is.
    """
    count = grid.cells * grid.cells
    if cells.samples[i * count + cell] == 0.0:
        return True
    nearness = wp.max(cells.nearness[j * count + cell], cells.nearness[i * count + cell])
    direction = direction_in_cell(cell, grid.cells, wp.vec2(0.5, 0.5))
    way = direction + nearness * (probes.position[j] - probes.position[i])
    return wp.dot(direction, wp.normalize(way)) > wp.cos(ANGLE_MAX * cell_width(grid.cells))
