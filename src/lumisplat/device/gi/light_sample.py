"""One sample of one light at a surface in real time, and its shadow ray (docs/method/realtime.md#direct)."""

import warp as wp

from lumisplat.device.gi.light_grid import grid_light
from lumisplat.device.light.direct_light import contribution_of, environment_sample
from lumisplat.device.light.light_choice import casts_shadow, chosen_light, vertex_at
from lumisplat.device.light.shadow_ray import start_shadow_ray
from lumisplat.device.material.bsdf import view_albedo
from lumisplat.device.math.color import is_black
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.path.sampled_light import sampled_light
from lumisplat.device.path.steps import branch_of
from lumisplat.device.structs.gi import LightGrid
from lumisplat.device.structs.light import BSDF_SIMPLE, LIGHT_ENVIRONMENT, Bsdf
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
def is_environment(number: int, scene: wp.array[ShadingScene]) -> bool:
    """Whether this light is the environment; the triangles that shine are one light more, after all others."""
    if number == scene[0].settings[0].light_count:
        return False
    return scene[0].lights[number].kind == LIGHT_ENVIRONMENT


@wp.func
def half_highlight(bsdf: Bsdf, cos_view: float) -> Bsdf:
    """The BSDF with no more of its diffuse part than of its highlight: half of its samples are of that.

    They would be rare and bright among those of the BSDF itself.
    """
    half = bsdf
    mirrored = bsdf.specular
    if bsdf.model != BSDF_SIMPLE:
        mirrored = view_albedo(bsdf, cos_view)
    if not is_black(mirrored):
        half.diffuse = wp.min(bsdf.diffuse, mirrored)
    half.rescattered = wp.vec3(0.0)
    return half


@wp.func
def sampled_environment(
    choice: LightChoice,
    interaction: Interaction,
    u: wp.vec2,
    which: float,
    scene: wp.array[ShadingScene],
) -> Contribution:
    """Contribution of the environment, over the probability of its choice, by one of two samples.

    One is of its radiance, the other one of the surface.

    Args:
        choice: The environment.
        interaction: The surface.
        u: Random, 0..1 each; the first one decides between the samples, so that all are stratified together.
        which: Random, 0..1.
        scene: The scene.
    """
    lobe = half_highlight(interaction.bsdf, wp.dot(interaction.normal, interaction.wo))
    samples_lobe = u[0] >= 0.5
    place = wp.vec2(2.0 * u[0] - wp.where(samples_lobe, 1.0, 0.0), u[1])
    sample = environment_sample(samples_lobe, lobe, interaction, place, which, scene)
    return contribution_of(interaction, sample, 2.0 / choice.probability)


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
    contribution = Contribution()
    if is_environment(choice.number, scene):
        contribution = sampled_environment(choice, interaction, u, which, scene)
    else:
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
