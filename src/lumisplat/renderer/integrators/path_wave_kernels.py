"""Kernels of all paths: they start paths, add the light of samples, and start the next rays. One thread per ray.

The kernels between them shade: those of ``path_kernels``, or the one of ``opaque_path_kernels``. Each of these modules
compiles for seconds, so frames load only what they need. The equations are in docs/method/paths.md.
"""

import warp as wp

from lumisplat.device.light.interaction import SHADE_OPTIONS
from lumisplat.device.math.color import is_black
from lumisplat.device.math.random import branch_key
from lumisplat.device.path.contributions import (
    PathImages,
    PathShadowRays,
    add_light,
    add_unshadowed_samples,
    diffuse_of,
)
from lumisplat.device.path.steps import PathData, PathSteps, start_path
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)


@wp.kernel
def begin_paths(start: int, paths_out: wp.array[PathData]):
    """Per camera ray: starts a path."""
    i = start + wp.tid()
    start_path(i, i, paths_out)
    if paths_out[0].media:
        paths_out[0].media[i] = wp.vec4i(0)


@wp.kernel
def add_sampled_light(
    start: int,
    number: int,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    paths: wp.array[PathData],
    shadows: wp.array[PathShadowRays],
    visibility: wp.array[wp.vec3],
    images_inout: wp.array[PathImages],
):
    """Adds the contributions of sampled lights, and of lights visible behind captures, times their visibility."""
    i = start + wp.tid()
    count = wave[0].rays.is_active.shape[0]
    if not wave[0].rays.is_active[i]:
        return
    for slot in range(shadows[0].contributions.shape[0] // count):
        j = slot * count + i
        arrived = shadows[0].contributions[j]
        if not is_black(arrived):
            for_catcher = paths[0].for_catcher[i] or shadows[0].skips[j]
            diffuse = diffuse_of(i, number, paths)
            visible = wp.vec3(1.0)
            if shadows[0].rays.is_active[j]:
                visible = visibility[j]
            if slot == 0:
                add_unshadowed_samples(i, number, visible, scene, paths, shadows, images_inout)
                if number == 0 and shadows[0].diffuse:
                    diffuse = shadows[0].diffuse[i]
            arrived = wp.cw_mul(arrived, visible)
            lights = scene[0].settings[0].light_count
            bounces = number + 1 - slot
            root = paths[0].root[i]
            add_light(root, for_catcher, arrived, bounces, shadows[0].lights[j], lights, diffuse, images_inout)


@wp.kernel
def spawn_paths(
    start: int,
    wave: wp.array[WaveData],
    paths: wp.array[PathData],
    steps: wp.array[PathSteps],
    rays_out: RayData,
    paths_out: wp.array[PathData],
):
    """Writes the next ray of each path that continues to the next bounce, without gaps in the arrays."""
    i = start + wp.tid()
    if steps[0].goes_on[i] == 0:
        return
    child = steps[0].next_ends[i] - 1
    rays_out.is_active[child] = True
    rays_out.origin[child] = steps[0].rays.origin[i]
    rays_out.direction[child] = steps[0].rays.direction[i]
    rays_out.t_min[child] = steps[0].rays.t_min[i]
    rays_out.normal[child] = steps[0].rays.normal[i]
    rays_out.t_max[child] = wp.inf
    rays_out.path_length[child] = steps[0].rays.path_length[i]
    rays_out.spread[child] = steps[0].rays.spread[i]
    rays_out.sample_key[child] = branch_key(wave[0].rays.sample_key[i], 0)
    rays_out.pixel_key[child] = branch_key(wave[0].rays.pixel_key[i], 0)
    rays_out.sample[child] = wave[0].rays.sample[i]
    paths_out[0].root[child] = paths[0].root[i]
    paths_out[0].throughput[child] = steps[0].paths.throughput[i]
    paths_out[0].pdf[child] = steps[0].paths.pdf[i]
    paths_out[0].position[child] = steps[0].paths.position[i]
    paths_out[0].normal[child] = steps[0].paths.normal[i]
    paths_out[0].importance[child] = steps[0].paths.importance[i]
    paths_out[0].is_specular[child] = steps[0].paths.is_specular[i]
    paths_out[0].for_catcher[child] = steps[0].paths.for_catcher[i]
    if paths_out[0].media:
        paths_out[0].media[child] = steps[0].paths.media[i]
    if paths_out[0].diffuse:
        paths_out[0].diffuse[child] = steps[0].paths.diffuse[i]
