"""One sample of one light at a surface in real time, and its shadow ray (docs/method/realtime.md#direct)."""

import warp as wp

from lumisplat.device.gi.light_grid import grid_light
from lumisplat.device.light.light_choice import casts_shadow, chosen_light, vertex_at
from lumisplat.device.light.shadow_ray import start_shadow_ray
from lumisplat.device.math.color import is_black
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.path.sampled_light import sampled_light
from lumisplat.device.path.steps import branch_of
from lumisplat.device.structs.gi import LightGrid
from lumisplat.device.structs.path import Branch, LightChoice
from lumisplat.device.structs.rays import Bounce, RayData
from lumisplat.device.structs.shading import Contribution, Interaction, ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})

# Branches of a ray's key.
POINT_BRANCH = wp.constant(2)
"""Which point of a light."""
LIGHT_BRANCH = wp.constant(3)
"""Which light, and which triangle of those that shine."""
SHADOW_BRANCH = wp.constant(5)
"""What blocks it."""
SURFACE_BRANCH = wp.constant(7)
"""Which surface of the ray."""
CELL_BRANCH = wp.constant(8)
"""Which cell of the light grid."""


@wp.func
def lit_surface(i: int, wave: wp.array[WaveData]) -> Branch:
    """Which of the surfaces on ray ``i`` is lit, in proportion to what about each reflects: its kind is its slot."""
    u = sobol_2d(branch_key(wave[0].rays.pixel_key[i], SURFACE_BRANCH), wave[0].rays.sample[i])
    return branch_of(i, u[0], False, Bounce(), wave)


@wp.func
def sample_choice(
    i: int,
    slot: int,
    choice: LightChoice,
    interaction: Interaction,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays: RayData,
) -> Contribution:
    """One sample of a light that was chosen; starts shadow ray ``i``, unless what it brings needs none.

    Args:
        i: The ray.
        slot: Which of its surfaces is lit: 0, Gaussians, or 1, a mesh.
        choice: The light.
        interaction: With that surface.
        no_shadows: Light passes through everything.
        scene: The scene.
        wave: Of the ray.
        rays: The shadow rays; ``i`` is not active before.
    """
    key = wave[0].rays.pixel_key[i]
    sample = wave[0].rays.sample[i]
    u = sobol_2d(branch_key(key, POINT_BRANCH), sample)
    which = sobol_2d(branch_key(key, LIGHT_BRANCH), sample)[1]
    contribution = sampled_light(choice, interaction, u, which, False, scene).contribution
    if is_black(contribution.color) or no_shadows or not casts_shadow(choice.number, scene):
        return contribution
    j = slot * wave[0].rays.is_active.shape[0] + i
    start_shadow_ray(i, j, choice.number, contribution, scene, wave, rays)
    rays.pixel_key[i] = branch_key(key, SHADOW_BRANCH)
    rays.sample_key[i] = branch_key(wave[0].rays.sample_key[i], SHADOW_BRANCH)
    rays.sample[i] = sample
    return contribution


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
    """As ``sample_choice``, of a light that is chosen by what each sends there; ``grid``: of the wave."""
    u = sobol_2d(branch_key(wave[0].rays.pixel_key[i], LIGHT_BRANCH), wave[0].rays.sample[i])
    choice = LightChoice()
    if grid.cell_of.shape[0] > 0:
        choice = grid_light(u[0], grid.cell_of[i], interaction, grid, scene)
    else:
        choice = chosen_light(u[0], vertex_at(interaction, scene), scene)
    if choice.number < 0:
        return Contribution()
    return sample_choice(i, slot, choice, interaction, no_shadows, scene, wave, rays)
