"""What rays see that leave surfaces in real time: they meet matte surfaces, and go on at smooth ones.

The method is in docs/method/realtime.md#rays.
"""

import warp as wp

from lumisplat.device.gi.albedo import matte_albedo
from lumisplat.device.gi.light_grid import SURFACE_BRANCH, sample_light_of
from lumisplat.device.gi.specular_rays import mirrored_light, start_onward, straight_bounce, straight_step
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.mesh_interaction import mesh_emission
from lumisplat.device.math.color import captured_color
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.path.steps import branch_of, is_scattering
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import BouncedRays, LightGrid, OnwardRays
from lumisplat.device.structs.light import BSDF_SIMPLE, Bsdf
from lumisplat.device.structs.path import BRANCH_NONE, BRANCH_REFLECTED, BRANCH_SPLATS
from lumisplat.device.structs.radiance_cache import CacheSamples
from lumisplat.device.structs.rays import Bounce, RayData
from lumisplat.device.structs.shading import Interaction, ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)


@wp.func
def unsampled_light(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> wp.vec3:
    """Linear radiance that ray ``i`` sees of what shines, but for the meshes that are sampled as lights."""
    seen = captured_color(wave[0].radiance.captured[i], wave[0].radiance.captured_weight[i])
    seen *= scene[0].settings[0].capture_gain
    seen += wave[0].radiance.light[i]
    if wave[0].meshes.face[i] >= 0 and scene[0].emitters.ends.shape[0] > 0:
        if scene[0].emitters.first[wave[0].meshes.instance[i]] >= 0:
            seen -= wave[0].gaussians.transmittance[i] * mesh_emission(i, scene, wave)
    return wp.max(seen, wp.vec3(0.0))


@wp.func
def matte(interaction: Interaction) -> Interaction:
    """The interaction with a surface that reflects as much, but evenly, and instead of what comes through, too."""
    albedo = matte_albedo(interaction.bsdf, wp.max(wp.dot(interaction.normal, interaction.wo), 0.0))
    interaction.bsdf = Bsdf()
    interaction.bsdf.model = BSDF_SIMPLE
    interaction.bsdf.diffuse = albedo
    interaction.weight = 1.0
    return interaction


@wp.kernel
def clear_bounced(start: int, samples_out: CacheSamples, bounced_out: BouncedRays, rays_out: RayData):
    """Item = ray: it has seen nothing yet, and met no surface."""
    i = start + wp.tid()
    rays_out.is_active[i] = False
    samples_out.is_active[i] = False
    bounced_out.seen[i] = wp.vec3(0.0)
    bounced_out.share[i] = wp.vec3(0.0)
    bounced_out.sampled[i] = wp.vec3(0.0)


@wp.kernel
def begin_onward(start: int, onward_out: OnwardRays):
    """Item = ray: it is at its beginning, in air, and does not go on yet."""
    i = start + wp.tid()
    onward_out.rays.is_active[i] = False
    onward_out.way[i] = 0.0
    onward_out.mirrored[i] = 0
    onward_out.weights[i] = wp.vec3(1.0)
    if onward_out.media:
        onward_out.media[i] = wp.vec4i(0)


@wp.kernel
def meet_surfaces(
    start: int,
    no_shadows: bool,
    grid: LightGrid,
    camera: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    samples_out: CacheSamples,
    bounced_out: BouncedRays,
    rays_out: RayData,
    onward_inout: OnwardRays,
):
    """Item = ray: what it sees, the surface that it meets, and one light there with its shadow ray; or it goes on.

    Args:
        start: First item.
        no_shadows: Light passes through everything.
        grid: Of the wave.
        camera: The camera of the frame.
        scene: The scene.
        wave: Of the rays.
        samples_out: The surfaces, without what they reflect.
        bounced_out: All else.
        rays_out: Shadow rays.
        onward_inout: Those that go on at smooth surfaces, whose arrays are those of the wave's rays from the second on.
    """
    i = start + wp.tid()
    follows = onward_inout.way.shape[0] > 0
    if follows:
        onward_inout.goes_on[i] = 0
    if not wave[0].rays.is_active[i]:
        return
    seen = unsampled_light(i, scene, wave)
    weight = wp.vec3(1.0)
    way = float(0.0)
    bounce = Bounce()
    if follows:
        weight = wave[0].weights[i]
        way = onward_inout.way[i]
        bounce = straight_bounce(i, scene, wave)
        if onward_inout.mirrored[i] != 0:
            seen += mirrored_light(i, way, no_shadows, scene, wave)
    bounced_out.seen[i] += wp.cw_mul(weight, seen)
    u = sobol_2d(branch_key(wave[0].rays.pixel_key[i], SURFACE_BRANCH), wave[0].rays.sample[i])
    surface = branch_of(i, u[0], False, bounce, wave)
    if surface.kind == BRANCH_NONE or not is_scattering(surface):
        if follows:
            onward_inout.rays.is_active[i] = False
        if surface.kind != BRANCH_NONE:
            step = straight_step(i, surface, bounce, scene, wave)
            onward_inout.goes_on[i] = 1
            onward_inout.way[i] = way + wave[0].meshes.t[i]
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
    samples_out.distance[i] = way + wp.length(interaction.position - wave[0].rays.origin[i])
    samples_out.from_eye[i] = wp.length(interaction.position - camera[0].eye)
    samples_out.albedo[i] = interaction.bsdf.diffuse
    samples_out.extent[i] = 0.0
    if surface.kind == BRANCH_SPLATS and scene[0].settings[0].shadow_offset > 0.0:
        samples_out.extent[i] = wave[0].interactions.spawn_t_min[j] / scene[0].settings[0].shadow_offset
    sample = sample_light_of(i, surface.kind, interaction, no_shadows, grid, scene, wave, rays_out)
    bounced_out.sampled[i] = sample.color
    if follows:
        onward_inout.rays.is_active[i] = False


@wp.kernel
def light_samples(
    start: int, bounced: BouncedRays, rays: RayData, visibility: wp.array[wp.vec3], samples_inout: CacheSamples
):
    """Item = ray: what the surface that it meets reflects of the sampled light."""
    i = start + wp.tid()
    radiance = bounced.sampled[i]
    if rays.is_active[i]:
        radiance = wp.cw_mul(radiance, visibility[i])
    samples_inout.radiance[i] = radiance


@wp.kernel
def add_reflected(
    start: int,
    bounced: BouncedRays,
    samples: CacheSamples,
    reflected: wp.array[wp.vec3],
    radiance_out: wp.array[wp.vec3],
    distance_out: wp.array[float],
):
    """Item = ray: all that it sees, and how far away.

    Args:
        start: First item.
        bounced: Of the rays.
        samples: The surfaces that they meet.
        reflected: What these reflect towards them, linear.
        radiance_out: Linear.
        distance_out: Scene units; inf: nowhere.
    """
    i = start + wp.tid()
    radiance_out[i] = bounced.seen[i]
    distance_out[i] = wp.inf
    if samples.is_active[i]:
        radiance_out[i] = bounced.seen[i] + wp.cw_mul(bounced.share[i], reflected[i])
        distance_out[i] = samples.distance[i]
