"""Direct light with shadow rays, light by light. One item is one ray of a wave, with its two interactions.

``spawn_shadow_rays`` and ``add_light`` run before and after the shadow rays of each light; ``darken_captured`` follows
the last light, for shadow-only sets.
"""

import warp as wp

from lumisplat.device.light.direct_light import light_contribution, shadow_ray_key
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.shadow_ray import start_shadow_ray
from lumisplat.device.light.splat_surface import is_over_light, shown_share, splat_surface
from lumisplat.device.material.media import scattered_media
from lumisplat.device.math.color import is_black
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import Arrivals, Contribution, ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)


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
    """Shadow rays from the interactions towards light ``number``, the media at their origins, and what it contributes.

    The contributions are unshadowed; ``media_out`` is without elements where no medium absorbs.
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
    arrivals_inout: Arrivals,
    direct_inout: wp.array[wp.vec3],
    arrived_inout: wp.array[wp.vec3],
):
    """Adds a light to the radiance of rays, times ``visibility`` if it is ``shadowed``.

    The last two arrays are the light's own images, without elements if the frame does not ask for them.
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
            if wave_inout[0].interactions.shadow_only[j]:
                arrivals_inout.sent[i] += sent
                arrivals_inout.arrived[i] += arrived
            else:
                wave_inout[0].radiance.light[i] += arrived
            if direct_inout:
                direct_inout[i] += sent
                arrived_inout[i] += arrived


@wp.kernel
def darken_captured(
    start: int,
    scene: wp.array[ShadingScene],
    arrivals: Arrivals,
    wave_inout: wp.array[WaveData],
):
    """The share of captured colours that shadows leave (differential rendering, Debevec 1998)."""
    i = start + wp.tid()
    sent = arrivals.sent[i]
    if is_black(sent) or not wave_inout[0].rays.is_active[i]:
        return
    over_light = is_over_light(i, scene, wave_inout)
    surface = splat_surface(i, over_light, scene, wave_inout)
    ambient = wp.PI * scene[0].materials[surface.instance].ambient
    blocked = sent - arrivals.arrived[i]
    share = shown_share(surface, over_light, scene)
    factor = wp.vec3(1.0)
    for k in range(3):
        if blocked[k] > 0.0 and share[k] > 0.0:
            factor[k] = 1.0 - share[k] * blocked[k] / (ambient[k] + sent[k])
    wave_inout[0].radiance.capture_factor[i] = factor
