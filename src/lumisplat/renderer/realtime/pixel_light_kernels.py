"""Direct light of the surfaces that pixels show: one sample of one light a pixel (docs/method/realtime.md#direct)."""

import warp as wp

from lumisplat.constants.realtime import ALBEDO_MIN
from lumisplat.device.camera.ray_blocks import pixel_of_ray
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.light_choice import casts_shadow, chosen_light, vertex_at
from lumisplat.device.light.shadow_ray import start_shadow_ray
from lumisplat.device.material.bsdf import diffuse_share
from lumisplat.device.math.color import is_black
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.path.sampled_light import sampled_light
from lumisplat.device.path.steps import scattering_share
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import FilteredLight, PixelLight, SurfaceLight, SurfacePixels
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)

LEAST_ALBEDO = wp.constant(wp.float32(ALBEDO_MIN))

# Branches of a ray's key.
POINT_BRANCH = wp.constant(2)
"""Which point of a light."""
LIGHT_BRANCH = wp.constant(3)
"""Which light, and which triangle of those that shine."""
SHADOW_BRANCH = wp.constant(5)
"""What blocks it."""
SURFACE_BRANCH = wp.constant(7)
"""Which surface of the pixel."""


@wp.func
def lit_slot(i: int, u: float, wave: wp.array[WaveData]) -> int:
    """Which of the surfaces on ray ``i`` is lit in this frame, in proportion to what about each reflects; -1: none."""
    of_splats = scattering_share(i, False, wave)
    total = of_splats + scattering_share(wave[0].rays.is_active.shape[0] + i, False, wave)
    if not (total > 0.0 and total < wp.inf):
        return -1
    return wp.where(u * total < of_splats, 0, 1)


@wp.kernel
def sample_lights(
    start: int,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    light_out: PixelLight,
    rays_out: RayData,
):
    """Item = ray: chooses one of its surfaces and a light, and starts the shadow ray."""
    i = start + wp.tid()
    rays_out.is_active[i] = False
    light_out.slot[i] = -1
    light_out.diffuse[i] = wp.vec3(0.0)
    light_out.glossy[i] = wp.vec3(0.0)
    light_out.passes[i] = False
    if not wave[0].rays.is_active[i]:
        return
    count = wave[0].rays.is_active.shape[0]
    key = wave[0].rays.pixel_key[i]
    sample = wave[0].rays.sample[i]
    slot = lit_slot(i, sobol_2d(branch_key(key, SURFACE_BRANCH), sample)[0], wave)
    light_out.slot[i] = slot
    if slot < 0:
        return
    interaction = load_interaction(slot * count + i, wave)
    interaction.weight = 1.0
    which = sobol_2d(branch_key(key, LIGHT_BRANCH), sample)
    choice = chosen_light(which[0], vertex_at(interaction, scene), scene)
    if choice.number < 0:
        return
    u = sobol_2d(branch_key(key, POINT_BRANCH), sample)
    contribution = sampled_light(choice, interaction, u, which[1], False, scene).contribution
    if is_black(contribution.color):
        return
    share = diffuse_share(interaction.bsdf, interaction.normal, interaction.wo, contribution.direction)
    diffuse = wp.cw_mul(share, contribution.color)
    light_out.diffuse[i] = diffuse
    light_out.glossy[i] = contribution.color - diffuse
    if no_shadows or not casts_shadow(choice.number, scene):
        return
    start_shadow_ray(i, slot * count + i, choice.number, contribution, scene, wave, rays_out)
    rays_out.pixel_key[i] = branch_key(key, SHADOW_BRANCH)
    rays_out.sample_key[i] = branch_key(wave[0].rays.sample_key[i], SHADOW_BRANCH)
    rays_out.sample[i] = sample


@wp.kernel
def store_light(
    start: int,
    slot: int,
    camera: wp.array[CameraData],
    light: PixelLight,
    rays: RayData,
    visibility: wp.array[wp.vec3],
    albedo: wp.array[wp.vec3],
    light_out: SurfaceLight,
):
    """Item = ray: writes what arrives as the sample of its pixel, for the surfaces of one kind.

    Args:
        start: First item.
        slot: The kind: 0, Gaussians, or 1, meshes.
        camera: The camera.
        light: Unshadowed.
        rays: The shadow rays.
        visibility: What each leaves, where it is active.
        albedo: Of the surfaces, one a pixel.
        light_out: Receives the samples.
    """
    i = start + wp.tid()
    at = pixel_of_ray(camera[0].width, i)
    if at[0] >= camera[0].width or at[1] >= camera[0].height:
        return
    pixel = at[1] * camera[0].width + at[0]
    light_out.is_sampled[pixel] = light.slot[i] == slot
    if light.slot[i] != slot:
        return
    diffuse = light.diffuse[i]
    glossy = light.glossy[i]
    if rays.is_active[i]:
        diffuse = wp.cw_mul(diffuse, visibility[i])
        glossy = wp.cw_mul(glossy, visibility[i])
    for channel in range(3):
        diffuse[channel] = diffuse[channel] / wp.max(albedo[pixel][channel], LEAST_ALBEDO)
    light_out.diffuse[pixel] = diffuse
    light_out.glossy[pixel] = glossy


@wp.kernel
def keep_shadow_only(start: int, wave_inout: wp.array[WaveData]):
    """Item = interaction: it exists no more unless it is with a shadow-only set."""
    j = start + wp.tid()
    if wave_inout[0].interactions.exists[j] and not wave_inout[0].interactions.shadow_only[j]:
        wave_inout[0].interactions.exists[j] = False


@wp.kernel
def add_surface_light(
    start: int,
    camera: wp.array[CameraData],
    wave: wp.array[WaveData],
    surfaces: SurfacePixels,
    light: FilteredLight,
    diffuse_inout: wp.array[wp.vec3],
    glossy_inout: wp.array[wp.vec3],
):
    """Item = ray: adds light of the surfaces of one kind to what the ray sees, and to its layers.

    Args:
        start: First item.
        camera: The camera.
        wave: Of the rays.
        surfaces: The surfaces.
        light: What they reflect.
        diffuse_inout: Layer, one element a ray.
        glossy_inout: Layer.
    """
    i = start + wp.tid()
    at = pixel_of_ray(camera[0].width, i)
    if at[0] >= camera[0].width or at[1] >= camera[0].height:
        return
    pixel = at[1] * camera[0].width + at[0]
    share = surfaces.share[pixel]
    if share <= 0.0:
        return
    albedo = wp.max(surfaces.albedo[pixel], wp.vec3(LEAST_ALBEDO))
    reflected = share * wp.cw_mul(albedo, light.diffuse[pixel])
    mirrored = share * light.glossy[pixel]
    wave[0].radiance.light[i] += reflected + mirrored
    diffuse_inout[i] += reflected
    glossy_inout[i] += mirrored
