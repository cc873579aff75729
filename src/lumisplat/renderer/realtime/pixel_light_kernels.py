"""Kernels of direct light at the surfaces of pixels, one light sample for each pixel.

The method is in docs/method/realtime.md#direct.
"""

import warp as wp

from lumisplat.device.camera.pixels import pixel_number, pixel_of_ray
from lumisplat.device.gi.light_grid import LightGrid, lit_surface, sample_light_of
from lumisplat.device.gi.light_visibility import (
    LightVisibility,
    has_visibility,
    light_by_uncertainty,
    remembered_highlight,
    sample_remembered,
)
from lumisplat.device.gi.surfaces import (
    FilteredLight,
    PixelLight,
    SequenceData,
    SurfaceLight,
    SurfacePixels,
    is_sampled_in_frame,
)
from lumisplat.device.light.direct_light import CHOICE_BRANCH, sample_choice
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.lobe_lights import angular_radius, eval_in_pixel, lobe_at, relevant_footprint, widened
from lumisplat.device.material.bsdf import bsdf_eval, diffuse_share
from lumisplat.device.math.color import is_black
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import Contribution, ShadingScene, WaveData

ALBEDO_MIN = 1e-3
"""Lower bound of albedos. Reflected diffuse light is divided by the albedo to get irradiance, and the irradiance is
filtered."""

wp.set_module_options(SHADE_OPTIONS)

LEAST_ALBEDO = wp.constant(wp.float32(ALBEDO_MIN))
LEAST = wp.constant(wp.float32(1e-30))


@wp.kernel
def number_samples(
    start: int,
    interval: int,
    sequence: wp.array[SequenceData],
    camera: wp.array[CameraData],
    wave_inout: wp.array[WaveData],
):
    """Per ray: if its pixel has a light sample in this frame, gives the sample the next low-discrepancy index.

    The index is one into a low-discrepancy sequence. The indices have no gaps.
    """
    i = start + wp.tid()
    frame = sequence[0].frame
    at = pixel_of_ray(camera[0].width, i)
    if wave_inout[0].rays.is_active[i] and is_sampled_in_frame(at[0], at[1], interval, frame):
        wave_inout[0].rays.sample[i] = (frame + interval - 1) // interval


@wp.kernel
def sample_lights(
    start: int,
    no_shadows: bool,
    interval: int,
    sequence: wp.array[SequenceData],
    grid: LightGrid,
    at_splats: LightVisibility,
    at_meshes: LightVisibility,
    camera: wp.array[CameraData],
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    footprint_of_splats: wp.array[float],
    footprint_of_meshes: wp.array[float],
    light_out: PixelLight,
    rays_out: RayData,
):
    """Per ray: chooses one of the ray's surfaces and a light, and starts the shadow ray.

    Args:
        start: Offset added to the thread index.
        no_shadows: Whether light passes through everything.
        interval: Number of frames from one sample of a pixel to the next, 1 or 2.
        sequence: The frame in its sequence; its number is read.
        grid: Light grid of the camera rays' surfaces.
        at_splats: Visibility of lights at splat surfaces in earlier frames.
        at_meshes: Visibility of lights at mesh surfaces in earlier frames.
        camera: Camera of the frame.
        scene: The scene.
        wave: The camera rays, after `number_samples`.
        footprint_of_splats: `SurfacePixels.footprint` of the splat surfaces, if the scene has any.
        footprint_of_meshes: The same of the mesh surfaces.
        light_out: Unshadowed samples.
        rays_out: Shadow rays.
    """
    i = start + wp.tid()
    rays_out.is_active[i] = False
    light_out.slot[i] = -1
    light_out.light[i] = -1
    light_out.diffuse[i] = wp.vec3(0.0)
    light_out.glossy[i] = wp.vec3(0.0)
    at = pixel_of_ray(camera[0].width, i)
    if not wave[0].rays.is_active[i] or not is_sampled_in_frame(at[0], at[1], interval, sequence[0].frame):
        return
    slot = lit_surface(i, wave).kind
    light_out.slot[i] = slot
    if slot < 0:
        return
    interaction = load_interaction(slot * wave[0].rays.is_active.shape[0] + i, wave)
    interaction.weight = 1.0
    footprint = float(0.0)
    pixel = pixel_number(i, camera)
    if pixel >= 0 and slot == 0:
        footprint = footprint_of_splats[pixel]
    elif pixel >= 0:
        footprint = footprint_of_meshes[pixel]
    footprint = relevant_footprint(footprint, interaction)
    bsdf = interaction.bsdf
    remembered = at_splats
    if slot == 1:
        remembered = at_meshes
    contribution = Contribution()
    of_diffuse = float(1.0)
    of_glossy = float(1.0)
    if remembered.counts and pixel >= 0:
        key = branch_key(wave[0].rays.pixel_key[i], CHOICE_BRANCH)
        u = sobol_2d(key, wave[0].rays.sample[i])
        choice = light_by_uncertainty(u[0], pixel, interaction, remembered, scene)
        if choice.number < 0:
            return
        if has_visibility(choice.number, scene):
            radius = angular_radius(choice.number, interaction.position, scene)
            shown = remembered_highlight(radius, lobe_at(interaction))
            interaction.bsdf = widened(bsdf, footprint)
            sampled = sample_remembered(
                i, slot, choice, shown, interaction, no_shadows, scene, wave, light_out, rays_out
            )
            contribution = sampled.contribution
            of_diffuse = sampled.diffuse
            of_glossy = sampled.glossy
        else:
            interaction.bsdf = widened(bsdf, footprint)
            contribution = sample_choice(i, slot, choice, interaction, no_shadows, scene, wave, rays_out)
    else:
        interaction.bsdf = widened(bsdf, footprint)
        contribution = sample_light_of(i, slot, interaction, no_shadows, grid, scene, wave, rays_out)
    if is_black(contribution.color) or of_diffuse + of_glossy <= 0.0:
        return
    direction = contribution.direction
    share = diffuse_share(bsdf, interaction.normal, interaction.wo, direction)
    if footprint <= 0.0:
        diffuse = wp.cw_mul(share, contribution.color)
        light_out.diffuse[i] = of_diffuse * diffuse
        light_out.glossy[i] = of_glossy * (contribution.color - diffuse)
        return
    in_wide = bsdf_eval(interaction.bsdf, interaction.normal, interaction.wo, direction)
    at_centre = bsdf_eval(bsdf, interaction.normal, interaction.wo, direction)
    in_pixel = eval_in_pixel(bsdf, footprint, interaction.normal, interaction.wo, direction)
    for channel in range(3):
        irradiance = contribution.color[channel] / wp.max(in_wide[channel], LEAST)
        scattered = share[channel] * at_centre[channel]
        light_out.diffuse[i][channel] = of_diffuse * irradiance * scattered
        light_out.glossy[i][channel] = of_glossy * irradiance * wp.max(in_pixel[channel] - scattered, 0.0)


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
    """Per ray: writes the shadowed light sample, its diffuse part divided by the albedo.

    Only samples on splat surfaces (``slot`` 0) or only those on mesh surfaces (1) are written.
    """
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
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
def select_shadow_catchers(start: int, wave_inout: wp.array[WaveData]):
    """Per interaction: deletes the interaction unless it is on a shadow catcher."""
    j = start + wp.tid()
    if wave_inout[0].interactions.exists[j] and not wave_inout[0].interactions.shadow_catcher[j]:
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
    """Per ray: adds the filtered light on its pixel's splat (or mesh) surface to its radiance and to two layers."""
    i = start + wp.tid()
    pixel = pixel_number(i, camera)
    if pixel < 0:
        return
    share = surfaces.share[pixel]
    if share <= 0.0:
        return
    albedo = wp.max(surfaces.albedo[pixel], wp.vec3(LEAST_ALBEDO))
    reflected = share * wp.cw_mul(albedo, light.diffuse[pixel])
    mirrored = share * light.glossy[pixel]
    wave[0].radiance.light[i] += reflected + mirrored
    diffuse_inout[i] += reflected
    glossy_inout[i] += mirrored
