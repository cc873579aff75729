"""Light grid: world-space cells, each with a few lights drawn at random from many; surfaces choose one of these.

Without a grid, surfaces in real-time rendering choose lights as paths do. See docs/method/realtime.md#light-grid.
"""

import warp as wp

from lumisplat.constants import GRID_LIGHTS, LIGHT_POWER_MAX
from lumisplat.device.gi.radiance_cache import exponent_of, width_of
from lumisplat.device.light.direct_light import (
    CHOICE_BRANCH,
    choice_count,
    chosen_light,
    light_importance,
    sample_choice,
    vertex_at,
    vertex_without_importance,
)
from lumisplat.device.light.light import LIGHT_ENVIRONMENT, light_bound
from lumisplat.device.light.lobe_lights import lobe_at, lobe_importance
from lumisplat.device.math.directions import PI
from lumisplat.device.math.random import BITS_8, branch_key, mix, sobol_2d
from lumisplat.device.path.steps import Branch, branch_of
from lumisplat.device.structs import struct
from lumisplat.device.structs.rays import Bounce, RayData
from lumisplat.device.structs.shading import (
    Contribution,
    EmitterData,
    Interaction,
    LightChoice,
    LightData,
    ShadingScene,
    WaveData,
)

GRID_CELL_SIZE = 1.0 / 4.0
"""Largest width of a light grid cell as a fraction of its distance from the eye; widths are powers of two."""

GRID_CHOICES = 4
"""Number of independent random selections of lights for each cell; a surface uses one of them, at random.

Together with the eight cells that a surface may use, this gives 32 selections: more than the 25 pixels whose noise is
assumed to be independent in the test for changes of light."""


@struct
class LightGrid:
    """World-space cells and the few lights that each stores for its surfaces to choose from."""

    cell_of: wp.array[int]
    """For each ray, the index of the light grid cell that its surface uses; -1: the ray has no surface.

    ``ALL_LIGHTS``: the surface chooses among all lights, because there are too many cells. An empty array: all surfaces
    do."""
    numbers: wp.array[int]
    """Indices of the lights stored for each cell, ``SLOTS`` consecutive elements per cell; -1: unused element."""
    chances: wp.array[float]
    """Probability with which each element of ``numbers`` was stored for its cell; 0: surfaces must not choose it."""


# Random branches of a ray's key.
SURFACE_BRANCH = wp.constant(7)
"""Branch of a ray's random key that selects one of its two surfaces: Gaussians or mesh."""

CELL_BRANCH = wp.constant(8)
"""Branch of a ray's random key that selects one of the light grid cells around its surface."""

SLOTS = wp.constant(GRID_LIGHTS + 1)
"""Number of lights stored for each cell: GRID_LIGHTS to choose from, and one more that is never chosen.

Lights are stored in the order of random ranks. The rank of the last one determines the probability with which each of
the others was stored."""

CHOICES = wp.constant(wp.float32(GRID_CHOICES))

CELL_SIZE = wp.constant(wp.float32(GRID_CELL_SIZE))

ALL_LIGHTS = wp.constant(-2)
"""Value of ``LightGrid.cell_of`` for a surface that chooses among all lights instead of those of a cell."""

NO_CELL = wp.constant(wp.int64(2**63 - 1))
"""Cell key of rays without a surface; larger than the keys of all cells."""

LEVEL_LAST = wp.constant(100)
"""Light grid cells are 2^n scene units wide, with -LEVEL_LAST <= n <= LEVEL_LAST."""

COORDINATES = wp.constant(2**17)
"""Cell coordinates lie between -COORDINATES and COORDINATES - 1 along each axis."""

BITS_18 = wp.constant(wp.int64(18))

LOW_18 = wp.constant(wp.int64(2**18 - 1))

BITS_2 = wp.constant(wp.int64(2))

ROOT_3 = wp.constant(wp.float32(3.0**0.5))

UNIT = wp.constant(wp.float32(2.0**-24))

LEAST = wp.constant(wp.float32(1e-30))

MOST = wp.constant(wp.float32(LIGHT_POWER_MAX))

FEW = wp.constant(wp.float32(0.01))
"""For x below this, power series replace ``log(1 - x)`` and ``1 - exp(-x)``, which would lose digits."""

grid_values = wp.types.vector(length=GRID_LIGHTS + 1, dtype=wp.float32)
"""Vector type with one float for each light that a cell stores."""


@wp.struct
class GridCell:
    """Centre and size of a cubic cell of the light grid."""

    center: wp.vec3
    """Centre of the cell, world space."""
    half: float
    """Half the cell's diagonal, scene units; surfaces that use the cell lie within twice this distance of its centre.
    """


@wp.func
def grid_key(position: wp.vec3, from_eye: float, u: wp.vec2, v: wp.vec2) -> wp.int64:
    """Returns the key of the light grid cell that a surface at ``position`` uses, at random among its neighbours.

    It is the cell that contains a random point of a cell-sized cube around the surface. ``u`` and ``v`` are random,
    0..1 each; ``v[1]`` selects one of the cell's independent selections of lights. ``from_eye`` is the distance from
    the eye.
    """
    width = wp.max(CELL_SIZE * from_eye, 2.0 * wp.max(wp.abs(position)) / float(COORDINATES))
    if not (width < wp.inf and wp.isfinite(position)):
        return NO_CELL
    level = wp.clamp(exponent_of(width), -LEVEL_LAST, LEVEL_LAST)
    scaled = position / width_of(level)
    key = wp.int64(level + LEVEL_LAST) << BITS_2
    key = key | wp.int64(wp.min(int(CHOICES * v[1]), int(CHOICES) - 1))
    for axis in range(3):
        offset = v[0]
        if axis < 2:
            offset = u[axis]
        coordinate = int(wp.floor(scaled[axis] + offset - 0.5)) + COORDINATES
        key = (key << BITS_18) | (wp.int64(wp.clamp(coordinate, 0, 2 * COORDINATES - 1)) & LOW_18)
    return key


@wp.func
def grid_cell(key: wp.int64) -> GridCell:
    """Returns position and size of the cell with a key."""
    width = width_of(int(key >> (wp.int64(3) * BITS_18 + BITS_2)) - LEVEL_LAST)
    cell = GridCell()
    for axis in range(3):
        coordinate = int((key >> (wp.int64(2 - axis) * BITS_18)) & LOW_18) - COORDINATES
        cell.center[axis] = width * (float(coordinate) + 0.5)
    cell.half = 0.5 * ROOT_3 * width
    return cell


@wp.func
def light_weight(light: LightData, environment_mean: float, cell: GridCell) -> float:
    """Estimates the irradiance by a light on surfaces in a cell that face it; above 0 if any point of the cell is lit.

    ``environment_mean`` is the mean luminance of the environment.
    """
    if light.kind == LIGHT_ENVIRONMENT:
        return PI * environment_mean
    return light_bound(light, cell.center, cell.half)


@wp.func
def emitter_weight(emitters: EmitterData, cell: GridCell) -> float:
    """Estimates the irradiance by all emissive triangles together on surfaces in a cell that face them."""
    away = emitters.center - cell.center
    nearest2 = wp.max(wp.dot(away, away), wp.max(cell.half * cell.half, emitters.radius * emitters.radius))
    return emitters.power / wp.max(nearest2, LEAST)


@wp.func
def bounded(weight: float) -> float:
    """Clamps a positive weight to 1e-30..1e30, so that dividing a random number by it stays finite; 0 stays 0."""
    if weight > 0.0:
        return wp.clamp(weight, LEAST, MOST)
    return 0.0


@wp.func
def exponential_draw(word: wp.uint32, number: int) -> float:
    """Draws an exponentially distributed random number of mean 1 for light ``number``; ``word`` is the random key.

    It is -log(1 - x), where x is the centre of one of 2^24 equal steps of 0..1.
    """
    x = (float(int(wp.rshift(mix(word + mix(wp.uint32(number))), BITS_8))) + 0.5) * UNIT
    if x < FEW:
        return x * (1.0 + x * (0.5 + x * (1.0 / 3.0 + 0.25 * x)))
    return wp.min(-wp.log(wp.max(1.0 - x, LEAST)), 20.0)


@wp.func
def chance_below(limit: float) -> float:
    """Returns ``1 - exp(-limit)``, the probability that an exponential random number of mean 1 is below ``limit``."""
    if limit < FEW:
        return limit * (1.0 - limit * (0.5 - limit * (1.0 / 6.0 - limit / 24.0)))
    return 1.0 - wp.exp(-limit)


@wp.func
def grid_light(
    u: float, cell: int, interaction: Interaction, grid: LightGrid, scene: wp.array[ShadingScene]
) -> LightChoice:
    """Chooses a light stored for ``cell`` with a chance proportional to importance / probability of being stored.

    The importance is the light's estimated irradiance at the interaction. ``u`` is random, 0..1. No light is chosen
    (index -1) if ``cell`` is -1 or all importances are 0.
    """
    choice = LightChoice()
    choice.number = -1
    if cell < 0:
        return choice
    vertex = vertex_without_importance(interaction)
    lobe = lobe_at(interaction)
    numbers = grid.numbers
    chances = grid.chances
    importance = grid_values()
    total = float(0.0)
    for slot in range(SLOTS):
        chance = chances[cell * SLOTS + slot]
        if chance > 0.0:
            number = numbers[cell * SLOTS + slot]
            importance[slot] = light_importance(number, vertex.position, vertex.normal, scene)
            if lobe.specular > 0.0:
                importance[slot] = lobe_importance(number, importance[slot], interaction, lobe, scene)
            total += importance[slot] / chance
    if not (total > 0.0 and total < wp.inf):
        return choice
    rest = u * total
    for slot in range(SLOTS):
        if importance[slot] > 0.0 and rest >= 0.0:
            choice.number = numbers[cell * SLOTS + slot]
            choice.probability = importance[slot] / total
            rest -= importance[slot] / chances[cell * SLOTS + slot]
    return choice


@wp.func
def light_of_all(u: float, interaction: Interaction, scene: wp.array[ShadingScene]) -> LightChoice:
    """Chooses one of all lights in proportion to its importance at the interaction; ``u`` is random, 0..1."""
    lobe = lobe_at(interaction)
    if lobe.specular <= 0.0:
        return chosen_light(u, vertex_at(interaction, scene), scene)
    vertex = vertex_without_importance(interaction)
    choice = LightChoice()
    choice.number = -1
    total = float(0.0)
    rest = u
    for number in range(choice_count(scene)):
        importance = light_importance(number, vertex.position, vertex.normal, scene)
        importance = lobe_importance(number, importance, interaction, lobe, scene)
        if importance > 0.0 and importance < wp.inf:
            total += importance
            chance = importance / total
            if rest < chance:
                choice.number = number
                choice.probability = importance
                rest = rest / chance
            else:
                rest = (rest - chance) / (1.0 - chance)
    if total > 0.0:
        choice.probability /= total
    return choice


@wp.func
def lit_surface(i: int, wave: wp.array[WaveData]) -> Branch:
    """Chooses which surface of ray ``i`` gets the light sample, in proportion to the light that each scatters.

    ``kind`` of the returned branch is 0 for Gaussians, 1 for a mesh, -1 for none.
    """
    u = sobol_2d(branch_key(wave[0].rays.pixel_key[i], SURFACE_BRANCH), wave[0].rays.sample[i])
    return branch_of(i, u[0], False, Bounce(), wave)


@wp.func
def sample_light_of(
    i: int,
    slot: int,
    interaction: Interaction,
    no_shadows: bool,
    grid: LightGrid,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays: RayData,
) -> Contribution:
    """Chooses a light for surface ``slot`` of ray ``i``, samples it, and starts the shadow ray to it.

    The light is chosen from the ray's cell if ``grid`` has cells, else from all lights. ``slot`` is 0 for Gaussians, 1
    for a mesh.
    """
    u = sobol_2d(branch_key(wave[0].rays.pixel_key[i], CHOICE_BRANCH), wave[0].rays.sample[i])
    cell = int(ALL_LIGHTS)
    if grid.cell_of.shape[0] > 0:
        cell = grid.cell_of[i]
    choice = LightChoice()
    if cell == ALL_LIGHTS:
        choice = light_of_all(u[0], interaction, scene)
    else:
        choice = grid_light(u[0], cell, interaction, grid, scene)
    if choice.number < 0:
        return Contribution()
    return sample_choice(i, slot, choice, interaction, no_shadows, scene, wave, rays)
