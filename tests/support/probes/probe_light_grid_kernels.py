"""Kernels that evaluate the light grid for its tests: weights in cells, and choices at surfaces."""

import warp as wp

from lumisplat.device.gi.light_grid import GridCell, LightGrid, bounded, grid_cell, grid_key, grid_light, light_weight
from lumisplat.device.light.direct_light import chosen_light, light_importance, vertex_at
from lumisplat.device.structs.shading import Interaction, LightChoice, ShadingScene

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_reach(
    centers: wp.array[wp.vec3],
    halves: wp.array[float],
    points: wp.array[wp.vec3],
    scene: wp.array[ShadingScene],
    weights_out: wp.array[float],
    importances_out: wp.array[float],
):
    """Evaluates the weight of light i in cell i, and its importance at point i."""
    i = wp.tid()
    cell = GridCell()
    cell.center = centers[i]
    cell.half = halves[i]
    weights_out[i] = bounded(light_weight(scene[0].lights[i], scene[0].environment.mean, cell))
    importances_out[i] = light_importance(i, points[i], wp.vec3(0.0, 0.0, 0.0), scene)


@wp.kernel
def probe_choices(
    draws: wp.array[float],
    cell: int,
    position: wp.vec3,
    normal: wp.vec3,
    grid: LightGrid,
    scene: wp.array[ShadingScene],
    numbers_out: wp.array[int],
    probabilities_out: wp.array[float],
):
    """Chooses a light at one surface for each draw, among the lights of a cell; cell -1 stands for all lights."""
    i = wp.tid()
    interaction = Interaction()
    interaction.position = position
    interaction.normal = normal
    choice = LightChoice()
    if cell >= 0:
        choice = grid_light(draws[i], cell, interaction, grid, scene)
    else:
        choice = chosen_light(draws[i], vertex_at(interaction, scene), scene)
    numbers_out[i] = choice.number
    probabilities_out[i] = choice.probability


@wp.kernel
def probe_cells(
    positions: wp.array[wp.vec3],
    from_eye: wp.array[float],
    draws: wp.array[wp.vec4],
    keys_out: wp.array[wp.int64],
    centers_out: wp.array[wp.vec3],
    halves_out: wp.array[float],
):
    """Finds the cells of surfaces."""
    i = wp.tid()
    u = draws[i]
    key = grid_key(positions[i], from_eye[i], wp.vec2(u[0], u[1]), wp.vec2(u[2], u[3]))
    cell = grid_cell(key)
    keys_out[i] = key
    centers_out[i] = cell.center
    halves_out[i] = cell.half
