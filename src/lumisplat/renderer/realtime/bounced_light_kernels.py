"""What rays see that leave surfaces in real time: they meet matte surfaces (docs/method/realtime.md#rays)."""

import warp as wp

from lumisplat.device.gi.albedo import diffuse_albedo, glossy_albedo
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.light_choice import casts_shadow, chosen_light, vertex_at
from lumisplat.device.light.mesh_interaction import mesh_emission
from lumisplat.device.light.shadow_ray import start_shadow_ray
from lumisplat.device.math.color import captured_color, is_black
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.path.sampled_light import sampled_light
from lumisplat.device.path.steps import scattering_share
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import BouncedRays
from lumisplat.device.structs.light import BSDF_SIMPLE, Bsdf
from lumisplat.device.structs.radiance_cache import CacheSamples
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import Interaction, ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)

# Branches of a ray's key.
POINT_BRANCH = wp.constant(2)
"""Which point of a light."""
LIGHT_BRANCH = wp.constant(3)
"""Which light, and which triangle of those that shine."""
SHADOW_BRANCH = wp.constant(5)
"""What blocks it."""
SURFACE_BRANCH = wp.constant(7)
"""Which surface of the ray."""


@wp.func
def unsampled_light(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> wp.vec3:
    """Linear radiance that ray ``i`` sees of what shines, but for the meshes that are sampled as lights."""
    seen = captured_color(wave[0].radiance.captured[i], wave[0].radiance.captured_weight[i])
    seen += wave[0].radiance.light[i]
    if wave[0].meshes.face[i] >= 0 and scene[0].emitters.ends.shape[0] > 0:
        if scene[0].emitters.first[wave[0].meshes.instance[i]] >= 0:
            seen -= wave[0].gaussians.transmittance[i] * mesh_emission(i, scene, wave)
    return wp.max(seen, wp.vec3(0.0))


@wp.func
def matte(interaction: Interaction) -> Interaction:
    """The interaction with a surface that reflects as much, but evenly in all directions."""
    cosine = wp.max(wp.dot(interaction.normal, interaction.wo), 0.0)
    albedo = diffuse_albedo(interaction.bsdf, cosine) + glossy_albedo(interaction.bsdf, cosine)
    interaction.bsdf = Bsdf()
    interaction.bsdf.model = BSDF_SIMPLE
    interaction.bsdf.diffuse = wp.min(albedo, wp.vec3(1.0))
    interaction.weight = 1.0
    return interaction


@wp.kernel
def meet_surfaces(
    start: int,
    no_shadows: bool,
    camera: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    samples_out: CacheSamples,
    bounced_out: BouncedRays,
    rays_out: RayData,
):
    """Item = ray: what it sees, the surface that it meets, and one light there with its shadow ray.

    Args:
        start: First item.
        no_shadows: Light passes through everything.
        camera: The camera of the frame.
        scene: The scene.
        wave: Of the rays.
        samples_out: The surfaces, without what they reflect.
        bounced_out: All else.
        rays_out: Shadow rays.
    """
    i = start + wp.tid()
    rays_out.is_active[i] = False
    samples_out.is_active[i] = False
    bounced_out.seen[i] = wp.vec3(0.0)
    bounced_out.share[i] = 0.0
    bounced_out.sampled[i] = wp.vec3(0.0)
    bounced_out.passes[i] = False
    if not wave[0].rays.is_active[i]:
        return
    bounced_out.seen[i] = unsampled_light(i, scene, wave)
    count = wave[0].rays.is_active.shape[0]
    key = wave[0].rays.pixel_key[i]
    sample = wave[0].rays.sample[i]
    of_splats = scattering_share(i, False, wave)
    total = of_splats + scattering_share(count + i, False, wave)
    if not (total > 0.0 and total < wp.inf):
        return
    slot = int(0)
    chance = of_splats / total
    if sobol_2d(branch_key(key, SURFACE_BRANCH), sample)[0] >= chance:
        slot = 1
        chance = 1.0 - chance
    j = slot * count + i
    interaction = load_interaction(j, wave)
    bounced_out.share[i] = interaction.weight / chance
    interaction = matte(interaction)
    samples_out.is_active[i] = True
    samples_out.position[i] = interaction.position
    samples_out.normal[i] = interaction.normal
    samples_out.direction[i] = wave[0].rays.direction[i]
    samples_out.distance[i] = wp.length(interaction.position - wave[0].rays.origin[i])
    samples_out.from_eye[i] = wp.length(interaction.position - camera[0].eye)
    samples_out.albedo[i] = interaction.bsdf.diffuse
    samples_out.extent[i] = 0.0
    if slot == 0 and scene[0].settings[0].shadow_offset > 0.0:
        samples_out.extent[i] = wave[0].interactions.spawn_t_min[j] / scene[0].settings[0].shadow_offset
    which = sobol_2d(branch_key(key, LIGHT_BRANCH), sample)
    choice = chosen_light(which[0], vertex_at(interaction, scene), scene)
    if choice.number < 0:
        return
    u = sobol_2d(branch_key(key, POINT_BRANCH), sample)
    contribution = sampled_light(choice, interaction, u, which[1], False, scene).contribution
    bounced_out.sampled[i] = contribution.color
    if is_black(contribution.color) or no_shadows or not casts_shadow(choice.number, scene):
        return
    start_shadow_ray(i, j, choice.number, contribution, scene, wave, rays_out)
    rays_out.pixel_key[i] = branch_key(key, SHADOW_BRANCH)
    rays_out.sample_key[i] = branch_key(wave[0].rays.sample_key[i], SHADOW_BRANCH)
    rays_out.sample[i] = sample


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
        radiance_out[i] = bounced.seen[i] + bounced.share[i] * reflected[i]
        distance_out[i] = samples.distance[i]
