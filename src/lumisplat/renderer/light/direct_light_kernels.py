"""Kernels of direct light with shadow rays, light by light. One thread per ray of a wave.

A ray has two interactions: with the surface of its Gaussians, and with the mesh behind. ``spawn_shadow_rays`` runs
before the shadow rays of each light are traced, ``add_light`` afterwards. ``darken_captured`` runs after the last
light, for shadow catchers.
"""

import warp as wp

from lumisplat.device.light.direct_light import light_contribution, shadow_ray_key
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.shadow_rays import start_shadow_ray
from lumisplat.device.light.splat_surface import (
    catcher_change,
    catcher_received,
    is_over_light,
    shown_share,
    splat_surface,
    weighted_factor,
)
from lumisplat.device.material.media import scattered_media
from lumisplat.device.math.color import is_black
from lumisplat.device.math.directions import around
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import CatcherIrradiance, CatcherLight, Contribution, ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)

AMBIENT_BRANCH = wp.constant(1 << 21)
"""Lowest of the numbers that derive the random keys of ambient rays from a ray's key. Lights and specular lobes use
lower numbers."""


@wp.kernel
def spawn_shadow_rays(
    start: int,
    number: int,
    samples_bsdf: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays_out: RayData,
    media_out: wp.array[wp.vec4i],
    contributions_out: wp.array[wp.vec3],
):
    """Per ray: writes a light's contributions without shadows, its shadow rays, and the media around their origins.

    ``number`` is the index of the light. ``media_out`` is empty if no medium absorbs.
    """
    i = start + wp.tid()
    stride = contributions_out.shape[0] // 2
    for slot in range(2):
        j = slot * stride + i
        contribution = Contribution()
        if wave[0].interactions.exists[j]:
            interaction = load_interaction(j, wave)
            contribution = light_contribution(
                number, samples_bsdf, interaction, wave[0].rays.pixel_key[i], wave[0].rays.sample[i], scene
            )
        contributions_out[j] = contribution.color
        rays_out.is_active[j] = not is_black(contribution.color)
        if rays_out.is_active[j]:
            start_shadow_ray(j, j, number, contribution, scene, wave, rays_out)
            rays_out.pixel_key[j] = shadow_ray_key(wave[0].rays.pixel_key[i], number, samples_bsdf, slot)
            rays_out.sample_key[j] = shadow_ray_key(wave[0].rays.sample_key[i], number, samples_bsdf, slot)
            rays_out.sample[j] = wave[0].rays.sample[i]
            if media_out:
                normal = wave[0].interactions.normal[j]
                media_out[j] = scattered_media(i, slot == 1, contribution.direction, normal, scene, wave)


@wp.kernel
def add_light(
    start: int,
    shadowed: bool,
    contributions: wp.array[wp.vec3],
    visibility: wp.array[wp.vec3],
    wave_inout: wp.array[WaveData],
    arrivals_inout: CatcherIrradiance,
    direct_inout: wp.array[wp.vec3],
    arrived_inout: wp.array[wp.vec3],
    catcher_light_inout: wp.array[wp.vec3],
):
    """Adds one light's contributions to the radiance of rays, times ``visibility`` if ``shadowed``.

    ``direct_inout`` and ``arrived_inout`` are images of the light without and with shadows; ``catcher_light_inout`` is
    the light's irradiance on shadow catchers. Each of the three is empty if the frame does not need it.
    """
    i = start + wp.tid()
    stride = contributions.shape[0] // 2
    for slot in range(2):
        j = slot * stride + i
        sent = contributions[j]
        if not is_black(sent):
            arrived = sent
            if shadowed:
                arrived = wp.cw_mul(sent, visibility[j])
            if wave_inout[0].interactions.shadow_catcher[j]:
                arrivals_inout.unshadowed[i] += sent
                arrivals_inout.shadowed[i] += arrived
                if catcher_light_inout:
                    catcher_light_inout[i] += sent
                    catcher_light_inout[stride + i] += arrived
            else:
                wave_inout[0].radiance.light[i] += arrived
                if direct_inout:
                    direct_inout[i] += sent
                    arrived_inout[i] += arrived


@wp.kernel
def spawn_ambient_rays(
    start: int,
    number: int,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays_out: RayData,
    media_out: wp.array[wp.vec4i],
):
    """Per ray: starts a cosine-weighted shadow ray from the shadow catcher that the ray hits, if any.

    ``number`` is the index of the ambient ray within the sample. ``media_out`` is empty if no medium absorbs.
    """
    i = start + wp.tid()
    stride = wave[0].interactions.exists.shape[0] // 2
    rays_out.is_active[stride + i] = False
    rays_out.is_active[i] = wave[0].interactions.exists[i] and wave[0].interactions.shadow_catcher[i]
    if rays_out.is_active[i]:
        key = branch_key(wave[0].rays.pixel_key[i], AMBIENT_BRANCH + number)
        u = sobol_2d(key, wave[0].rays.sample[i])
        ray = Contribution()
        ray.direction = around(wave[0].interactions.normal[i], wp.sqrt(1.0 - u[0]), wp.sqrt(u[0]), u[1])
        ray.distance = wp.inf
        start_shadow_ray(i, i, scene[0].settings[0].light_count, ray, scene, wave, rays_out)
        rays_out.pixel_key[i] = branch_key(key, 0)
        rays_out.sample_key[i] = branch_key(wave[0].rays.sample_key[i], AMBIENT_BRANCH + number)
        rays_out.sample[i] = wave[0].rays.sample[i]
        if media_out:
            normal = wave[0].interactions.normal[i]
            media_out[i] = scattered_media(i, False, ray.direction, normal, scene, wave)


@wp.kernel
def add_ambient_visibility(start: int, rays: RayData, visibility: wp.array[wp.vec3], arrivals_inout: CatcherIrradiance):
    """Per ray that hits a shadow catcher: adds the visibility of the ray's ambient shadow ray to the catcher's sum."""
    i = start + wp.tid()
    if rays.is_active[i]:
        arrivals_inout.open[i] += visibility[i]


@wp.kernel
def darken_captured(
    start: int,
    ambient_rays: int,
    scene: wp.array[ShadingScene],
    arrivals_inout: CatcherIrradiance,
    wave_inout: wp.array[WaveData],
):
    """Writes the factor by which shadows darken a captured colour (differential rendering, Debevec 1998).

    The part of the captured colour that the scene's lights cause is subtracted from the emission; `add_catcher_light`
    adds this part to the lights' images.

    Args:
        start: Offset added to the thread index.
        ambient_rays: Number of ambient shadow rays per item; 0: ambient light is not blocked.
        scene: The scene.
        arrivals_inout: Irradiance on the catchers without and with shadows; receives the catchers' reflectance.
        wave_inout: The wave.
    """
    i = start + wp.tid()
    sent = arrivals_inout.unshadowed[i]
    arrivals_inout.reflectance[i] = wp.vec3(0.0)
    if not wave_inout[0].rays.is_active[i] or not wave_inout[0].interactions.exists[i]:
        return
    if not wave_inout[0].interactions.shadow_catcher[i]:
        return
    over_light = is_over_light(i, scene, wave_inout)
    surface = splat_surface(i, over_light, scene, wave_inout)
    share = shown_share(surface, over_light, scene)
    weight = wave_inout[0].radiance.captured_weight[i]
    factor = wp.vec3(1.0)
    reflectance = wp.vec3(0.0)
    for k in range(3):
        light = CatcherLight()
        light.unshadowed = sent[k]
        light.change = arrivals_inout.shadowed[i][k] - sent[k]
        light.ambient = wp.PI * scene[0].materials[surface.instance].ambient[k]
        light.least = wp.PI * surface.albedo[k]
        if ambient_rays > 0:
            light.blocked = light.ambient * (1.0 - arrivals_inout.open[i][k] / float(ambient_rays))
        if share[k] > 0.0:
            factor[k] = weighted_factor(wp.max(1.0 + share[k] * catcher_change(light), 0.0), weight)
        if sent[k] > 0.0:
            reflectance[k] = surface.share * surface.albedo[k] / catcher_received(light)
    wave_inout[0].radiance.capture_factor[i] = factor
    arrivals_inout.reflectance[i] = reflectance
    if wave_inout[0].radiance.emission:
        wave_inout[0].radiance.emission[i] -= wp.cw_mul(reflectance, arrivals_inout.shadowed[i])


@wp.kernel
def add_catcher_light(
    start: int,
    arrivals: CatcherIrradiance,
    catcher_light: wp.array[wp.vec3],
    direct_inout: wp.array[wp.vec3],
    arrived_inout: wp.array[wp.vec3],
):
    """Per ray: adds to one light's images the part of a shadow catcher's captured colour that this light causes."""
    i = start + wp.tid()
    direct_inout[i] += wp.cw_mul(arrivals.reflectance[i], catcher_light[i])
    arrived_inout[i] += wp.cw_mul(arrivals.reflectance[i], catcher_light[catcher_light.shape[0] // 2 + i])
