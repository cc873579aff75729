"""Rays within highlights: which surfaces send them, and where to (docs/method/realtime.md#glossy)."""

import warp as wp

from lumisplat.device.camera.ray_blocks import ray_of_pixel
from lumisplat.device.gi.albedo import glossy_albedo, highlight_width
from lumisplat.device.gi.lobes import ALPHA_TO, followed_pixel
from lumisplat.device.light.glossy_lobe import LOBE_BRANCH, highlight_share, interaction_of, lobe_of
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.math.color import is_black
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gi import LobeRays
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import WaveData

wp.set_module_options(SHADE_OPTIONS)

CHOICE_BRANCH = wp.constant((1 << 20) + 3)
"""Branch of a ray's key: which of its surfaces sends a ray on."""


@wp.func
def traced_share(j: int, wave: wp.array[WaveData]) -> float:
    """Share of a ray that the highlight of interaction ``j`` reflects, if rays follow it."""
    interaction = interaction_of(j, wave)
    if highlight_width(interaction.bsdf) >= ALPHA_TO:
        return 0.0
    return highlight_share(interaction)


@wp.kernel
def choose_lobes(
    start: int,
    frame: int,
    camera: wp.array[CameraData],
    wave: wp.array[WaveData],
    lobes_out: LobeRays,
    follows_out: wp.array[int],
):
    """Item = square of pixels: the surface that sends a ray, by what each of a pixel's two reflects.

    Args:
        start: First item.
        frame: Its number.
        camera: Of the frame.
        wave: The first rays.
        lobes_out: Receives pixels and slots.
        follows_out: Receives 1 for each ray.
    """
    square = start + wp.tid()
    width = camera[0].width
    lobes_out.slot[square] = -1
    follows_out[square] = 0
    at = followed_pixel(square, frame, width)
    if at[0] >= width or at[1] >= camera[0].height:
        return
    i = ray_of_pixel(width, at[0], at[1])
    if not wave[0].rays.is_active[i]:
        return
    splats = traced_share(i, wave)
    total = splats + traced_share(wave[0].rays.is_active.shape[0] + i, wave)
    if total <= 0.0:
        return
    u = sobol_2d(branch_key(wave[0].rays.pixel_key[i], CHOICE_BRANCH), wave[0].rays.sample[i])
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
    """Item = square of pixels: starts its ray.

    Args:
        start: First item.
        camera: Of the frame.
        wave: The first rays.
        ends: Number of rays up to that of each square, and with it.
        lobes_inout: Receives numbers and weights.
        rays_out: The rays, none of which is active before.
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
    rays_out.path_length[ray] = 0.0  # what a surface scatters does not depend on how far away the eye is
    rays_out.spread[ray] = 0.0
    rays_out.sample_key[ray] = branch_key(wave[0].rays.sample_key[i], LOBE_BRANCH)
    rays_out.pixel_key[ray] = branch_key(wave[0].rays.pixel_key[i], LOBE_BRANCH)
    rays_out.sample[ray] = wave[0].rays.sample[i]
