"""Kernels that add light at the hits of reflected and refracted rays in real time (docs/method/realtime.md#mirrors)."""

import warp as wp

from lumisplat.device.gi.light_grid import ALL_LIGHTS, CELL_BRANCH, SLOTS, LightGrid, lit_surface, sample_light_of
from lumisplat.device.gi.radiance_cache import CacheSamples
from lumisplat.device.gi.surfaces import matte_albedo
from lumisplat.device.light.direct_light import sample_choice
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.math.directions import around
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.path.steps import Branch
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import Interaction, LightChoice, ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)


@wp.func
def jittered_point(j: int, ray: int, width: float, interaction: Interaction, wave: wp.array[WaveData]) -> wp.vec3:
    """Returns a random point within ``width`` of interaction ``j``, in the surface's plane, to hide cell edges."""
    key = branch_key(wave[0].rays.sample_key[ray], CELL_BRANCH + j // wave[0].rays.is_active.shape[0])
    u = sobol_2d(key, 0)
    return interaction.position + (width * wp.sqrt(u[0])) * around(interaction.normal, 0.0, 1.0, u[1])


@wp.kernel
def list_surfaces(
    start: int,
    cell_size: float,
    camera: wp.array[CameraData],
    wave: wp.array[WaveData],
    samples_out: CacheSamples,
    points_out: wp.array[wp.vec3],
):
    """Per interaction: writes its surface as a query of the radiance cache, and a point in the surface's plane.

    The cache is looked up at the point, which is random within half of ``cell_size`` (the width of cells as a fraction
    of their distance). If ``cell_size`` is 0, the point is the hit itself.
    """
    j = start + wp.tid()
    ray = j % wave[0].rays.is_active.shape[0]
    exists = wave[0].rays.is_active[ray] and wave[0].interactions.exists[j]
    samples_out.is_active[j] = exists
    if not exists:
        return
    interaction = load_interaction(j, wave)
    cosine = wp.max(wp.dot(interaction.normal, interaction.wo), 0.0)
    samples_out.from_eye[j] = wp.length(interaction.position - camera[0].eye)
    samples_out.position[j] = interaction.position
    points_out[j] = jittered_point(j, ray, 0.5 * cell_size * samples_out.from_eye[j], interaction, wave)
    samples_out.normal[j] = interaction.normal
    samples_out.direction[j] = -interaction.wo
    samples_out.distance[j] = wp.length(interaction.position - wave[0].rays.origin[ray])
    samples_out.albedo[j] = matte_albedo(interaction.bsdf, cosine)
    samples_out.radiance[j] = wp.vec3(0.0)
    samples_out.extent[j] = 0.0


@wp.kernel
def add_cached(start: int, indirect: wp.array[wp.vec3], wave_inout: wp.array[WaveData]):
    """Per ray: adds the indirect light that its surfaces reflect. ``indirect`` has one element for each interaction."""
    i = start + wp.tid()
    count = wave_inout[0].rays.is_active.shape[0]
    if not wave_inout[0].rays.is_active[i]:
        return
    for slot in range(2):
        j = slot * count + i
        if wave_inout[0].interactions.exists[j] and not wave_inout[0].interactions.shadow_catcher[j]:
            wave_inout[0].radiance.light[i] += wave_inout[0].interactions.weight[j] * indirect[j]


@wp.func
def sample_surface(
    i: int,
    surface: Branch,
    number: int,
    chance: float,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays_out: RayData,
) -> wp.vec3:
    """Samples light ``number``, chosen with probability ``chance``, at a surface of ray ``i``; starts a shadow ray.

    Returns the contribution without shadow.
    """
    choice = LightChoice()
    choice.number = number
    choice.probability = surface.probability * chance
    if choice.probability <= 0.0:
        return wp.vec3(0.0)
    interaction = load_interaction(surface.kind * wave[0].rays.is_active.shape[0] + i, wave)
    return sample_choice(i, surface.kind, choice, interaction, no_shadows, scene, wave, rays_out).color


@wp.kernel
def sample_emitters(
    start: int,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    contributions_out: wp.array[wp.vec3],
    rays_out: RayData,
):
    """Per ray: samples a point on the emissive triangles for one of the ray's surfaces, and starts the shadow ray."""
    i = start + wp.tid()
    contributions_out[i] = wp.vec3(0.0)
    rays_out.is_active[i] = False
    if not wave[0].rays.is_active[i]:
        return
    surface = lit_surface(i, wave)
    if surface.kind >= 0:
        number = scene[0].settings[0].light_count
        contributions_out[i] = sample_surface(i, surface, number, 1.0, False, scene, wave, rays_out)


@wp.kernel
def sample_light_of_cells(
    start: int,
    slot: int,
    no_shadows: bool,
    grid: LightGrid,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    contributions_out: wp.array[wp.vec3],
    rays_out: RayData,
):
    """Per ray: samples light ``slot`` of its surface's grid cell, and starts the shadow ray.

    ``slot`` is an index into the lights stored for the cell. The contribution is divided by the light's probability.
    Surfaces that choose from all lights have one sample, in slot 0.
    """
    i = start + wp.tid()
    contributions_out[i] = wp.vec3(0.0)
    rays_out.is_active[i] = False
    cell = grid.cell_of[i]
    if cell >= 0:
        at = cell * SLOTS + slot
        surface = lit_surface(i, wave)
        contributions_out[i] = sample_surface(
            i, surface, grid.numbers[at], grid.chances[at], no_shadows, scene, wave, rays_out
        )
    elif cell == ALL_LIGHTS and slot == 0:
        surface = lit_surface(i, wave)
        interaction = load_interaction(surface.kind * wave[0].rays.is_active.shape[0] + i, wave)
        sample = sample_light_of(i, surface.kind, interaction, no_shadows, grid, scene, wave, rays_out)
        contributions_out[i] = sample.color / surface.probability


@wp.kernel
def add_samples(
    start: int,
    contributions: wp.array[wp.vec3],
    rays: RayData,
    visibility: wp.array[wp.vec3],
    wave_inout: wp.array[WaveData],
):
    """Per ray: adds a light sample, times its visibility, to the ray's radiance."""
    i = start + wp.tid()
    light = contributions[i]
    if rays.is_active[i]:
        light = wp.cw_mul(light, visibility[i])
    wave_inout[0].radiance.light[i] += light


@wp.kernel
def subtract(start: int, wave: wp.array[WaveData], before: wp.array[wp.vec3], difference_out: wp.array[wp.vec3]):
    """Per ray: writes the radiance that reflections and refractions added: its radiance minus ``before``."""
    i = start + wp.tid()
    difference_out[i] = wave[0].radiance.light[i] - before[i]
