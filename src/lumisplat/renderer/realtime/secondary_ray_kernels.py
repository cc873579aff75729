"""Kernels of secondary rays in real time: rays start within highlights, pass smooth surfaces and end at rough ones.

The method is in docs/method/realtime.md#rays and #glossy.
"""

import warp as wp

from lumisplat.device.camera.pixels import ray_of_pixel
from lumisplat.device.gi.light_grid import SURFACE_BRANCH, LightGrid, sample_light_of
from lumisplat.device.gi.radiance_cache import CacheGrid, CacheSamples, CacheTiles, cell_of_sample, slot_of
from lumisplat.device.gi.secondary_rays import (
    ALPHA_TO,
    BouncedRays,
    LobeRays,
    OnwardRays,
    followed_pixel,
    light_that_arrives,
    mirrored_light,
    start_onward,
    straight_bounce,
    straight_step,
)
from lumisplat.device.gi.surfaces import SequenceData, glossy_albedo, highlight_width, matte_albedo
from lumisplat.device.light.direct_light import CHOICE_BRANCH, sample_choice
from lumisplat.device.light.glossy_lobe import LOBE_BRANCH, highlight_share, interaction_of, lobe_of
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction, mesh_emission
from lumisplat.device.math.color import captured_color, is_black, luminance
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.path.steps import BRANCH_NONE, BRANCH_REFLECTED, BRANCH_SPLATS, branch_of, is_scattering
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.rays import Bounce, RayData
from lumisplat.device.structs.shading import BSDF_SIMPLE, Bsdf, Contribution, Interaction, ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)


@wp.func
def unsampled_light(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> wp.vec3:
    """Returns the linear radiance emitted along ray ``i``, without that of meshes that surfaces sample as lights."""
    radiance = captured_color(wave[0].radiance.captured[i], wave[0].radiance.captured_weight[i])
    radiance *= scene[0].settings[0].capture_gain
    radiance += wave[0].radiance.light[i]
    if wave[0].meshes.face[i] >= 0 and scene[0].emitters.ends.shape[0] > 0:
        if scene[0].emitters.first[wave[0].meshes.instance[i]] >= 0:
            radiance -= wave[0].gaussians.transmittance[i] * mesh_emission(i, scene, wave)
    return wp.max(radiance, wp.vec3(0.0))


@wp.func
def matte(interaction: Interaction) -> Interaction:
    """Returns an interaction with a diffuse BSDF whose albedo is all light that the original reflects and transmits."""
    albedo = matte_albedo(interaction.bsdf, wp.max(wp.dot(interaction.normal, interaction.wo), 0.0))
    interaction.bsdf = Bsdf()
    interaction.bsdf.model = BSDF_SIMPLE
    interaction.bsdf.diffuse = albedo
    interaction.weight = 1.0
    return interaction


@wp.kernel
def clear_rays(start: int, samples_out: CacheSamples, bounced_out: BouncedRays, rays_out: RayData):
    """Per secondary ray: clears its hit, its radiance and its light sample, and deactivates its shadow ray."""
    i = start + wp.tid()
    rays_out.is_active[i] = False
    samples_out.is_active[i] = False
    samples_out.light[i] = -1
    bounced_out.emitted[i] = wp.vec3(0.0)
    bounced_out.share[i] = wp.vec3(0.0)
    bounced_out.sampled[i] = wp.vec3(0.0)


@wp.kernel
def begin_onward(start: int, onward_out: OnwardRays):
    """Per ray: sets the initial state of a ray that may continue: in air, weight 1, not continued yet."""
    i = start + wp.tid()
    onward_out.rays.is_active[i] = False
    onward_out.length_before[i] = 0.0
    onward_out.mirrored[i] = 0
    onward_out.weights[i] = wp.vec3(1.0)
    if onward_out.media:
        onward_out.media[i] = wp.vec4i(0)


@wp.kernel
def shade_hits(
    start: int,
    no_shadows: bool,
    grid: LightGrid,
    cache: CacheGrid,
    tiles: CacheTiles,
    camera: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    samples_out: CacheSamples,
    bounced_out: BouncedRays,
    rays_out: RayData,
    onward_inout: OnwardRays,
):
    """Per ray: writes radiance, hit surface and a light sample with its shadow ray; or continues at a smooth surface.

    Args:
        start: Offset added to the thread index.
        no_shadows: Whether light passes through everything.
        grid: Light grid of the surfaces that the rays hit.
        cache: Settings of the radiance cache.
        tiles: Tiles of the radiance cache, which know which lights arrive.
        camera: Camera of the frame.
        scene: The scene.
        wave: The rays and their hits.
        samples_out: The surfaces, without reflected radiance.
        bounced_out: Radiance of the rays, without the light that the surfaces reflect.
        rays_out: Shadow rays.
        onward_inout: Rays that continue at smooth surfaces; from the second bounce on, ``wave`` has these same arrays.
    """
    i = start + wp.tid()
    follows = onward_inout.length_before.shape[0] > 0
    if follows:
        onward_inout.goes_on[i] = 0
    if not wave[0].rays.is_active[i]:
        return
    radiance = unsampled_light(i, scene, wave)
    weight = wp.vec3(1.0)
    length = float(0.0)
    bounce = Bounce()
    if follows:
        weight = wave[0].weights[i]
        length = onward_inout.length_before[i]
        bounce = straight_bounce(i, scene, wave)
        if onward_inout.mirrored[i] != 0:
            radiance += mirrored_light(i, length, no_shadows, scene, wave)
    bounced_out.emitted[i] += wp.cw_mul(weight, radiance)
    u = sobol_2d(branch_key(wave[0].rays.pixel_key[i], SURFACE_BRANCH), wave[0].rays.sample[i])
    surface = branch_of(i, u[0], False, bounce, wave)
    if surface.kind == BRANCH_NONE or not is_scattering(surface):
        if follows:
            onward_inout.rays.is_active[i] = False
        if surface.kind != BRANCH_NONE:
            step = straight_step(i, surface, bounce, scene, wave)
            onward_inout.goes_on[i] = 1
            onward_inout.length_before[i] = length + wave[0].meshes.t[i]
            onward_inout.weights[i] = wp.cw_mul(weight, step.weight)
            if surface.kind == BRANCH_REFLECTED:
                onward_inout.mirrored[i] = 1
            if onward_inout.media:
                onward_inout.media[i] = step.media
            start_onward(i, surface.kind, step, wave, onward_inout.rays)
        return
    j = surface.kind * wave[0].rays.is_active.shape[0] + i
    interaction = load_interaction(j, wave)
    bounced_out.share[i] = (interaction.weight / surface.probability) * weight
    interaction = matte(interaction)
    samples_out.is_active[i] = True
    samples_out.position[i] = interaction.position
    samples_out.normal[i] = interaction.normal
    samples_out.direction[i] = wave[0].rays.direction[i]
    samples_out.distance[i] = length + wp.length(interaction.position - wave[0].rays.origin[i])
    samples_out.from_eye[i] = wp.length(interaction.position - camera[0].eye)
    samples_out.albedo[i] = interaction.bsdf.diffuse
    samples_out.extent[i] = 0.0
    if surface.kind == BRANCH_SPLATS and scene[0].settings[0].shadow_offset > 0.0:
        samples_out.extent[i] = wave[0].interactions.spawn_t_min[j] / scene[0].settings[0].shadow_offset
    sample = Contribution()
    if grid.cell_of.shape[0] > 0:
        sample = sample_light_of(i, surface.kind, interaction, no_shadows, grid, scene, wave, rays_out)
    else:
        at = cell_of_sample(cache, samples_out, i)
        of_light = sobol_2d(branch_key(wave[0].rays.pixel_key[i], CHOICE_BRANCH), wave[0].rays.sample[i])
        choice = light_that_arrives(of_light[0], slot_of(tiles, at.key), at.cell, interaction, tiles, scene)
        if choice.number >= 0:
            sample = sample_choice(i, surface.kind, choice, interaction, no_shadows, scene, wave, rays_out)
            samples_out.light[i] = choice.number
    bounced_out.sampled[i] = sample.color
    if follows:
        onward_inout.rays.is_active[i] = False


@wp.kernel
def apply_visibility(
    start: int, bounced: BouncedRays, rays: RayData, visibility: wp.array[wp.vec3], samples_inout: CacheSamples
):
    """Per secondary ray: writes the reflected light sample at its hit, times the visibility of the shadow ray."""
    i = start + wp.tid()
    radiance = bounced.sampled[i]
    arrived = wp.where(is_black(radiance), 0.0, 1.0)
    if rays.is_active[i]:
        radiance = wp.cw_mul(radiance, visibility[i])
        arrived = luminance(visibility[i])
    samples_inout.radiance[i] = radiance
    samples_inout.arrived[i] = arrived


@wp.kernel
def add_reflected(
    start: int,
    bounced: BouncedRays,
    samples: CacheSamples,
    reflected: wp.array[wp.vec3],
    radiance_out: wp.array[wp.vec3],
    distance_out: wp.array[float],
):
    """Per secondary ray: writes its radiance, emitted plus reflected at the hit, and the hit distance; inf: no hit."""
    i = start + wp.tid()
    radiance_out[i] = bounced.emitted[i]
    distance_out[i] = wp.inf
    if samples.is_active[i]:
        radiance_out[i] = bounced.emitted[i] + wp.cw_mul(bounced.share[i], reflected[i])
        distance_out[i] = samples.distance[i]


SENDER_BRANCH = wp.constant((1 << 20) + 3)
"""Number that derives a random key from a ray's key: the key for choosing the surface that sends a ray within its
highlight."""


@wp.func
def traced_share(j: int, wave: wp.array[WaveData]) -> float:
    """Returns the fraction of light that the highlight of interaction ``j`` reflects; 0 if the highlight is too wide.

    A highlight is too wide for rays if its roughness alpha is at least ``ALPHA_TO``.
    """
    interaction = interaction_of(j, wave)
    if highlight_width(interaction.bsdf) >= ALPHA_TO:
        return 0.0
    return highlight_share(interaction)


@wp.kernel
def choose_lobes(
    start: int,
    sequence: wp.array[SequenceData],
    camera: wp.array[CameraData],
    wave: wp.array[WaveData],
    lobes_out: LobeRays,
    follows_out: wp.array[int],
):
    """Per 2 x 2 pixels: chooses which surface sends a ray within its highlight, in proportion to reflectance.

    ``follows_out`` is 1 for each square that sends a ray.
    """
    square = start + wp.tid()
    width = camera[0].width
    lobes_out.slot[square] = -1
    follows_out[square] = 0
    at = followed_pixel(square, sequence[0].frame, width)
    if at[0] >= width or at[1] >= camera[0].height:
        return
    i = ray_of_pixel(width, at[0], at[1])
    if not wave[0].rays.is_active[i]:
        return
    splats = traced_share(i, wave)
    total = splats + traced_share(wave[0].rays.is_active.shape[0] + i, wave)
    if total <= 0.0:
        return
    u = sobol_2d(branch_key(wave[0].rays.pixel_key[i], SENDER_BRANCH), wave[0].rays.sample[i])
    lobes_out.pixel[square] = at[1] * width + at[0]
    lobes_out.slot[square] = wp.where(u[0] * total < splats, 0, 1)
    follows_out[square] = 1


@wp.kernel
def start_lobes(
    start: int,
    camera: wp.array[CameraData],
    wave: wp.array[WaveData],
    ends: wp.array[int],
    lobes_inout: LobeRays,
    rays_out: RayData,
):
    """Per 2 x 2 pixels: starts the ray within a highlight, if the square sends one; ``ends`` is a prefix sum of rays.

    All rays must be inactive before.
    """
    square = start + wp.tid()
    slot = lobes_inout.slot[square]
    if slot < 0:
        return
    pixel = lobes_inout.pixel[square]
    i = ray_of_pixel(camera[0].width, pixel % camera[0].width, pixel // camera[0].width)
    interaction = load_interaction(slot * wave[0].rays.is_active.shape[0] + i, wave)
    lobe = lobe_of(i, slot, interaction, wave)
    albedo = glossy_albedo(interaction.bsdf, wp.max(wp.dot(interaction.normal, interaction.wo), 0.0))
    ray = ends[square] - 1
    lobes_inout.ray[square] = ray
    lobes_inout.weight[square] = wp.cw_div(lobe.weight, wp.max(albedo, wp.vec3(1.0e-6)))
    rays_out.is_active[ray] = not is_black(lobe.weight)
    rays_out.origin[ray] = lobe.origin
    rays_out.direction[ray] = lobe.direction
    rays_out.t_min[ray] = lobe.t_min
    rays_out.normal[ray] = lobe.normal
    rays_out.t_max[ray] = wp.inf
    rays_out.path_length[ray] = 0.0  # scattered radiance does not depend on the eye's distance
    rays_out.spread[ray] = 0.0
    rays_out.sample_key[ray] = branch_key(wave[0].rays.sample_key[i], LOBE_BRANCH)
    rays_out.pixel_key[ray] = branch_key(wave[0].rays.pixel_key[i], LOBE_BRANCH)
    rays_out.sample[ray] = wave[0].rays.sample[i]
