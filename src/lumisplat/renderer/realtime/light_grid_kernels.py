"""Kernels of the light grid: they find the cells of surfaces and choose lights for cells.

Each array element is written once and depends on its cell alone, so the result is the same for any schedule. The method
is in docs/method/realtime.md#light-grid.
"""

import warp as wp

from lumisplat.device.gi.light_grid import (
    ALL_LIGHTS,
    CELL_BRANCH,
    NO_CELL,
    SLOTS,
    GridCell,
    LightGrid,
    bounded,
    chance_below,
    emitter_weight,
    exponential_draw,
    grid_cell,
    grid_key,
    light_weight,
    lit_surface,
)
from lumisplat.device.gi.radiance_cache import cell_key
from lumisplat.device.light.direct_light import choice_count
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def find_cells(
    start: int,
    camera: wp.array[CameraData],
    wave: wp.array[WaveData],
    keys_out: wp.array[wp.int64],
    order_out: wp.array[int],
):
    """Per ray: writes a grid cell's key: of the cell with the surface for which the ray's pixel samples a light."""
    i = start + wp.tid()
    order_out[i] = i
    keys_out[i] = NO_CELL
    if not wave[0].rays.is_active[i]:
        return
    surface = lit_surface(i, wave)
    if surface.kind < 0:
        return
    position = wave[0].interactions.position[surface.kind * wave[0].rays.is_active.shape[0] + i]
    key = branch_key(wave[0].rays.pixel_key[i], CELL_BRANCH)
    sample = wave[0].rays.sample[i]
    u = sobol_2d(branch_key(key, 0), sample)
    v = sobol_2d(branch_key(key, 1), sample)
    keys_out[i] = grid_key(position, wp.length(position - camera[0].eye), u, v)


@wp.kernel
def mark_cells(start: int, keys: wp.array[wp.int64], is_first_out: wp.array[int]):
    """Per ray, in order of cell keys: writes 1 if the ray is the first one of its grid cell, else 0."""
    i = start + wp.tid()
    is_first = keys[i] != NO_CELL
    if i > 0 and is_first:
        is_first = keys[i] != keys[i - 1]
    is_first_out[i] = int(is_first)


@wp.kernel
def list_cells(
    start: int,
    cells_max: int,
    keys: wp.array[wp.int64],
    order: wp.array[int],
    ends: wp.array[int],
    cell_of_out: wp.array[int],
    cells_out: wp.array[wp.int64],
):
    """Per ray, in order of keys: writes the index of the ray's cell. A cell's first ray also writes the cell's key.

    Surfaces in cells beyond the first ``cells_max`` choose from all lights.
    """
    i = start + wp.tid()
    number = ends[i] - 1
    if keys[i] == NO_CELL:
        number = -1
    elif number >= cells_max:
        number = ALL_LIGHTS
    cell_of_out[order[i]] = number
    if number >= 0 and (i == 0 or keys[wp.max(i - 1, 0)] != keys[i]):
        cells_out[number] = keys[i]


@wp.func
def weight_of(number: int, cell: GridCell, scene: wp.array[ShadingScene]) -> float:
    """Returns the sampling weight of light ``number`` in a cell; all emissive meshes together are the last light."""
    if number == scene[0].settings[0].light_count:
        return bounded(emitter_weight(scene[0].emitters, cell))
    return bounded(light_weight(scene[0].lights[number], scene[0].environment.mean, cell))


@wp.func
def largest_rank(ranks: wp.array[float], first: int) -> int:
    """Returns the index of the light with the largest rank (random number over weight) among a cell's stored lights."""
    largest = first
    for slot in range(1, SLOTS):
        if ranks[first + slot] > ranks[largest]:
            largest = first + slot
    return largest


@wp.kernel
def choose_lights(
    start: int, cells: wp.array[wp.int64], ends: wp.array[int], scene: wp.array[ShadingScene], grid_out: LightGrid
):
    """Per cell: samples lights without replacement: the lights with the smallest ranks.

    A rank is an exponential random number divided by the light's weight. The largest stored rank gives the probability
    with which each other stored light was chosen.
    """
    c = start + wp.tid()
    if c >= ends[ends.shape[0] - 1]:
        return
    cell = grid_cell(cells[c])
    word = cell_key(cells[c], int(scene[0].sample[0].seed), scene[0].sample[0].index)
    numbers = grid_out.numbers
    ranks = grid_out.chances
    first = c * SLOTS
    found = int(0)
    last = int(first)
    for number in range(choice_count(scene)):
        weight = weight_of(number, cell, scene)
        if weight <= 0.0:
            continue
        rank = exponential_draw(word, number) / weight
        if found < SLOTS:
            numbers[first + found] = number
            ranks[first + found] = rank
            found += 1
            if found == SLOTS:
                last = largest_rank(ranks, first)
        elif rank < ranks[last]:
            numbers[last] = number
            ranks[last] = rank
            last = largest_rank(ranks, first)
    limit = wp.inf
    if found == SLOTS:
        limit = ranks[last]
    for slot in range(SLOTS):
        at = first + slot
        if slot >= found:
            numbers[at] = -1
            ranks[at] = 0.0
        elif found == SLOTS and at == last:
            ranks[at] = 0.0
        elif found == SLOTS:
            ranks[at] = chance_below(limit * weight_of(numbers[at], cell, scene))
        else:
            ranks[at] = 1.0
