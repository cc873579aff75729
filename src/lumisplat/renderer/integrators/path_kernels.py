"""Shading of paths: a wave has one ray of each path that is still alive. One thread per ray.

``add_hit_radiance`` adds the emitted radiance at the rays' hits and the environment radiance behind the hits.
``continue_paths`` samples a light and the next direction. The other kernels measure the light on shadow catchers. The
equations are in docs/method/paths.md.
"""

import warp as wp

from lumisplat.device.light.direct_light import environment_number, vertex_at
from lumisplat.device.light.interaction import SHADE_OPTIONS
from lumisplat.device.light.splat_surface import is_over_light, splat_surface
from lumisplat.device.material.media import passed_by_ray
from lumisplat.device.math.color import captured_color, is_black
from lumisplat.device.math.directions import PI
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.path.contributions import (
    PathImages,
    PathShadowRays,
    add_emitted_light,
    add_hit_lights,
    add_light,
    add_unshadowed_light,
    clear_shadow_ray,
    diffuse_of,
    emitted_radiance,
    escaped_radiance,
    leaves_catcher,
    light_surface,
    ray_escaped_radiance,
    start_along,
)
from lumisplat.device.path.steps import (
    BRANCH_NONE,
    DIRECTION_BRANCH,
    ROULETTE_BRANCH,
    SURFACE_BRANCH,
    PathData,
    PathStep,
    PathSteps,
    bounce_at,
    branch_of,
    is_scattering,
    scattered_step,
    scattering_interaction,
    specular_step,
    store_step,
    survival,
)
from lumisplat.device.structs.rays import GaussianHits, RayData
from lumisplat.device.structs.shading import PathVertex, ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)

AMBIENT_BRANCH = wp.constant(9)
"""Number that derives a random key from a ray's key: the key of an ambient shadow ray from a shadow catcher, for
stochastic shadows of Gaussians."""


@wp.kernel
def leave_receivers(start: int, wave: wp.array[WaveData], paths: wp.array[PathData], ends_out: wp.array[float]):
    """Per ray: writes the distance at which its trace by `RayTracer.find_captured` ends.

    The distance is infinite for rays that leave shadow catchers. It is -1 for other rays, which are not traced.
    """
    i = start + wp.tid()
    ends_out[i] = -1.0
    if wave[0].rays.is_active[i] and leaves_catcher(i, paths):
        ends_out[i] = wp.inf


@wp.func
def catcher_ambient(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> wp.vec3:
    """Returns the ambient irradiance on the shadow catcher that camera ray ``i`` hits."""
    surface = splat_surface(i, is_over_light(i, scene, wave), scene, wave)
    return PI * scene[0].materials[surface.instance].ambient


@wp.kernel
def start_ambient_rays(
    start: int,
    wave: wp.array[WaveData],
    paths: wp.array[PathData],
    images: wp.array[PathImages],
    rays_out: RayData,
    skips_out: wp.array[wp.bool],
):
    """Per ray that leaves a shadow catcher: starts a shadow ray along it if ambient light reaches the catcher."""
    i = start + wp.tid()
    skips_out[i] = True
    rays_out.is_active[i] = False
    if wave[0].rays.is_active[i] and leaves_catcher(i, paths):
        rays_out.is_active[i] = not is_black(images[0].ambient[paths[0].root[i]])
        start_along(i, i, wp.inf, AMBIENT_BRANCH, wave, rays_out)


@wp.kernel
def add_ambient_visibility(
    start: int,
    rays: RayData,
    visibility: wp.array[wp.vec3],
    paths: wp.array[PathData],
    images_inout: wp.array[PathImages],
):
    """Stores, for each shadow catcher, its ambient irradiance times the visibility found by rays past added objects."""
    i = start + wp.tid()
    if rays.is_active[i]:
        root = paths[0].root[i]
        images_inout[0].open[root] = wp.cw_mul(visibility[i], images_inout[0].ambient[root])


@wp.kernel
def add_captured_light(
    start: int,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    paths: wp.array[PathData],
    captured: GaussianHits,
    images_inout: wp.array[PathImages],
):
    """Adds the light on shadow catchers that the capture alone causes, without added objects.

    A path that leaves a shadow catcher estimates the irradiance: radiance from other shadow catchers, and from the
    environment behind these catchers.

    Args:
        start: Offset added to the thread index, which is the index of a ray.
        no_shadows: Whether light passes through everything.
        scene: The scene.
        wave: The rays, all after the same number of bounces.
        paths: The paths of the rays.
        captured: Radiance from shadow catchers only, along the rays that leave shadow catchers.
        images_inout: Images that receive the light.
    """
    i = start + wp.tid()
    if not (wave[0].rays.is_active[i] and leaves_catcher(i, paths)):
        return
    throughput = paths[0].throughput[i]
    emitted = scene[0].settings[0].capture_gain * captured_color(captured.color[i], 1.0 - captured.transmittance[i])
    escaped = captured.transmittance[i] * escaped_radiance(i, wave[0].rays.direction[i], no_shadows, paths, scene)
    # Computed as in ``add_hit_radiance``, so that equal light gives equal numbers.
    add_emitted_light(paths[0].root[i], wp.cw_mul(throughput, emitted), images_inout)
    add_unshadowed_light(paths[0].root[i], wp.cw_mul(throughput, escaped), images_inout)


@wp.kernel
def add_hit_radiance(
    start: int,
    number: int,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave_inout: wp.array[WaveData],
    paths: wp.array[PathData],
    shadows_out: wp.array[PathShadowRays],
    images_inout: wp.array[PathImages],
):
    """Adds the radiance emitted at the rays' hits, and the environment radiance behind the hits.

    Args:
        start: Offset added to the thread index, which is the index of a ray.
        number: Index of the wave.
        no_shadows: Whether light passes through everything.
        scene: The scene.
        wave_inout: The wave; in the first one, pixels of visible lights become opaque.
        paths: The paths of the wave.
        shadows_out: Receives shadow rays to lights that are visible behind captures.
        images_inout: Images that receive the radiance.
    """
    i = start + wp.tid()
    count = wave_inout[0].rays.is_active.shape[0]
    clear_shadow_ray(i, shadows_out)
    if shadows_out[0].contributions.shape[0] > count:
        clear_shadow_ray(count + i, shadows_out)
    if not wave_inout[0].rays.is_active[i]:
        return
    lights = scene[0].settings[0].light_count
    environment_index = environment_number(scene)
    if environment_index < 0:
        environment_index = lights
    escaped = wave_inout[0].gaussians.transmittance[i] * ray_escaped_radiance(
        i, number, no_shadows, paths, scene, wave_inout
    )
    emitted = wp.vec3(0.0)
    if number == 0:
        # The first wave's light includes emission and the environment, which are added separately below.
        emitted = wave_inout[0].radiance.light[i] - escaped
        wave_inout[0].radiance.light[i] = wp.vec3(0.0)
    else:
        emitted = emitted_radiance(i, no_shadows, paths, scene, wave_inout)
    throughput = wp.cw_mul(paths[0].throughput[i], passed_by_ray(i, scene, wave_inout))
    diffuse = diffuse_of(i, number, paths)
    root, for_catcher = paths[0].root[i], paths[0].for_catcher[i]
    add_light(root, for_catcher, wp.cw_mul(throughput, emitted), number, lights, lights, diffuse, images_inout)
    add_light(
        root, for_catcher, wp.cw_mul(throughput, escaped), number, environment_index, lights, diffuse, images_inout
    )
    add_hit_lights(i, number, no_shadows, scene, wave_inout, paths, shadows_out, images_inout)


@wp.kernel
def continue_paths(
    start: int,
    number: int,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    paths: wp.array[PathData],
    shadows_inout: wp.array[PathShadowRays],
    images_inout: wp.array[PathImages],
    steps_out: wp.array[PathSteps],
):
    """Chooses the surface by which each path continues, samples a light there, and samples the next direction.

    Args:
        start: Offset added to the thread index, which is the index of a ray.
        number: Index of the wave.
        no_shadows: Whether light passes through everything.
        scene: The scene.
        wave: The wave.
        paths: The paths of the wave.
        shadows_inout: Receives shadow rays to the lights.
        images_inout: Images of the frame; the kernel marks the paths that measure the irradiance of shadow catchers.
        steps_out: Receives the next rays of the paths.
    """
    i = start + wp.tid()
    steps_out[0].goes_on[i] = 0
    if not wave[0].rays.is_active[i]:
        return
    key = wave[0].rays.pixel_key[i]
    sample = wave[0].rays.sample[i]
    may_find_catcher = bool(False)  # only at primary hits
    if images_inout[0].unshadowed:
        may_find_catcher = number == 0
    bounce = bounce_at(i, scene, wave)
    u_surface = sobol_2d(branch_key(key, SURFACE_BRANCH), sample)
    branch = branch_of(i, u_surface[0], may_find_catcher, bounce, wave)
    if branch.kind == BRANCH_NONE:
        return

    factor = wp.cw_mul(paths[0].throughput[i], passed_by_ray(i, scene, wave)) / branch.probability
    vertex = PathVertex()
    step = PathStep()
    for_catcher = paths[0].for_catcher[i]
    if is_scattering(branch):
        interaction = scattering_interaction(i, branch, wave)
        if interaction.shadow_catcher:
            for_catcher = True
            factor = wp.vec3(1.0)
            images_inout[0].received[paths[0].root[i]] = wp.vec3(1.0)
            images_inout[0].ambient[paths[0].root[i]] = catcher_ambient(i, scene, wave)
        vertex = vertex_at(interaction, scene)
        light_surface(i, branch.kind, factor, no_shadows, interaction, vertex, scene, wave, shadows_inout)
        u = sobol_2d(branch_key(key, DIRECTION_BRANCH), sample)
        splits = bool(False)
        if steps_out[0].paths.diffuse:
            splits = number == 0
        step = scattered_step(i, branch, interaction, u, u_surface[1], splits, scene, wave)
    else:
        step = specular_step(i, branch, bounce, scene, wave)
    throughput = wp.cw_mul(factor, step.weight)
    chance = survival(number, throughput, sobol_2d(branch_key(key, ROULETTE_BRANCH), sample)[0])
    if chance <= 0.0:
        return
    store_step(i, step, vertex, wave, steps_out)
    steps_out[0].paths.throughput[i] = throughput / chance
    steps_out[0].paths.is_specular[i] = paths[0].is_specular[i] and not is_scattering(branch)
    steps_out[0].paths.for_catcher[i] = for_catcher
    if steps_out[0].paths.diffuse and number > 0:
        steps_out[0].paths.diffuse[i] = paths[0].diffuse[i]
