"""Where screen probes are: one a tile, more where those miss surfaces, continued from the frame before.

The method is in docs/method/realtime.md#screen-probes. Every kernel writes each element from one item only.
"""

import warp as wp

from lumisplat.constants.realtime import PROBE_STAYS_PX
from lumisplat.device.camera.seen_at import seen_at
from lumisplat.device.gi.octahedral import cell_of_direction, cell_width, direction_in_cell
from lumisplat.device.gi.probe_places import LOOKED_AT, place_among, place_in_tile
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import ProbeCells, ProbeData, ProbeGrid, SurfacePixels, TileNeeds

wp.set_module_options({"enable_backward": False})

STAYS_PX = wp.constant(wp.float32(PROBE_STAYS_PX))


@wp.kernel
def keep_probes(start: int, probes: ProbeData, probes_out: ProbeData):
    """Copies what the next frame asks of a probe."""
    i = start + wp.tid()
    probes_out.is_placed[i] = probes.is_placed[i]
    probes_out.position[i] = probes.position[i]
    probes_out.normal[i] = probes.normal[i]
    probes_out.extent[i] = probes.extent[i]
    probes_out.rounds[i] = probes.rounds[i]
    probes_out.refreshed[i] = probes.refreshed[i]


@wp.kernel
def keep_cells(start: int, cells: ProbeCells, cells_out: ProbeCells):
    """Copies a cell."""
    i = start + wp.tid()
    cells_out.radiance[i] = cells.radiance[i]
    cells_out.nearness[i] = cells.nearness[i]
    cells_out.samples[i] = cells.samples[i]


@wp.func
def is_as_before(
    pixel: int, source: int, grid: ProbeGrid, camera: CameraData, surfaces: SurfacePixels, before: ProbeData
) -> bool:
    """Whether probe ``source`` of the frame before may stay where it was: the surface stands still, and is this one.

    Samples move in their pixels: a probe that went along would lose what it sees near at hand.
    """
    if not wp.length(surfaces.previous[pixel] - surfaces.position[pixel]) == 0.0:  # NaN: it is new
        return False
    center = wp.vec2(float(pixel % grid.width) + 0.5, float(pixel // grid.width) + 0.5)
    return wp.length(seen_at(camera, before.position[source]) - center) < STAYS_PX


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
    """Puts probe ``i`` on the surface of a pixel, or leaves it near there where it was; none if that is -1."""
    probes_out.is_placed[i] = 0
    probes_out.source[i] = -1
    probes_out.rounds[i] = 0
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
        probes_out.rounds[i] = before.rounds[source]
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
    """Places the probe of a tile."""
    tile = start + wp.tid()
    place = place_in_tile(tile, grids[0], cameras[0], cameras_before[0], surfaces, before, adaptive_before)
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
    """What the tiles' probes miss of a tile, and a key by which tiles that need more come first."""
    tile = start + wp.tid()
    place = place_among(
        LOOKED_AT, tile, True, grids[0], cameras[0], cameras_before[0], surfaces, probes, before, adaptive_before
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
    """Gives one of the tiles, in their order, an adaptive probe if it needs one and there are any left."""
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
    """Takes the cells of the probe that a probe continues to where they are seen from its new place.

    A cell whose hit is nearer than the probe has moved keeps its direction: the hit says nothing of the new place.
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
                way = direction + nearness * move
                stretch = wp.length(way)
                if stretch > 0.0:
                    nearness /= stretch
                    direction = way / stretch
                    to_cell = i * count + cell_of_direction(direction, side)
            # Below the horizon of a mesh no ray renews a cell.
            if probes.extent[i] == 0.0 and wp.dot(direction, probes.normal[i]) < -cell_width(side):
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
