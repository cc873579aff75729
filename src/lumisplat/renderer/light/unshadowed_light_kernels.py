"""Lights that nothing blocks, at both surfaces of a ray. One item is one ray."""

import warp as wp

from lumisplat.device.light.direct_light import from_center, from_environment, from_extent
from lumisplat.device.light.interaction import (
    SHADE_OPTIONS,
    has_mesh,
    has_ray,
    has_splats,
    is_over_light,
    mesh_point,
    splat_point,
    splat_surface,
)
from lumisplat.device.structs.light import LIGHT_ENVIRONMENT
from lumisplat.device.structs.rays import GaussianHits, RayData, RayMeshHits
from lumisplat.device.structs.shading import Interaction, ShadingScene

wp.set_module_options(SHADE_OPTIONS)


@wp.func
def is_unblocked(number: int, nothing_blocks: bool, scene: wp.array(dtype=ShadingScene)) -> bool:
    """Whether light ``number`` goes through everything."""
    return nothing_blocks or scene[0].lights[number].casts_shadow == 0


@wp.func
def by_centers(point: Interaction, nothing_blocks: bool, scene: wp.array(dtype=ShadingScene)) -> wp.vec3:
    """What the lights that nothing blocks add by way of a surface, but for the environment."""
    total = wp.vec3(0.0)
    for number in range(scene[0].settings[0].light_count):
        if is_unblocked(number, nothing_blocks, scene) and scene[0].lights[number].kind != LIGHT_ENVIRONMENT:
            total += from_center(number, point, scene).color
    return total


@wp.func
def by_samples(
    point: Interaction, pixel_key: wp.uint32, nothing_blocks: bool, scene: wp.array(dtype=ShadingScene)
) -> wp.vec3:
    """What those of them add that chance looks at: the environment, and soft lights."""
    total = wp.vec3(0.0)
    for number in range(scene[0].settings[0].light_count):
        if is_unblocked(number, nothing_blocks, scene):
            if scene[0].lights[number].kind == LIGHT_ENVIRONMENT:
                total += from_environment(number, False, point, pixel_key, scene).color
                total += from_environment(number, True, point, pixel_key, scene).color
            elif scene[0].settings[0].soft != 0:
                total += from_extent(number, point, pixel_key, scene).color
    return total


@wp.kernel
def add_hard_lights(
    start: int,
    from_camera: bool,
    nothing_blocks: bool,
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    hits: RayMeshHits,
    radiance: GaussianHits,
    light_inout: wp.array(dtype=wp.vec3),
):
    """Adds the lights that nothing blocks, all of each at its centre.

    Apart from ``add_sampled_lights``: together, they cost a deferred frame an eighth more.
    """
    i = start + wp.tid()
    if not has_ray(rays, i):
        return
    look = splat_surface(i, hits, radiance, scene, is_over_light(i, from_camera, hits, scene))
    light = light_inout[i]
    if has_splats(look, scene):
        splats = splat_point(i, look, rays, radiance, scene)
        if splats.shadow_only == 0:
            light += by_centers(splats, nothing_blocks, scene)
    if has_mesh(i, look, hits):
        mesh = mesh_point(i, look.transmittance, rays, hits, scene, scene[0].splats.shape[0])
        if mesh.exists != 0:
            light += by_centers(mesh, nothing_blocks, scene)
    light_inout[i] = light


@wp.kernel
def add_sampled_lights(
    start: int,
    from_camera: bool,
    nothing_blocks: bool,
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    hits: RayMeshHits,
    radiance: GaussianHits,
    light_inout: wp.array(dtype=wp.vec3),
):
    """Adds those of the lights that nothing blocks at which chance looks."""
    i = start + wp.tid()
    if not has_ray(rays, i):
        return
    look = splat_surface(i, hits, radiance, scene, is_over_light(i, from_camera, hits, scene))
    light = light_inout[i]
    if has_splats(look, scene):
        splats = splat_point(i, look, rays, radiance, scene)
        if splats.shadow_only == 0:
            light += by_samples(splats, rays.pixel_key[i], nothing_blocks, scene)
    if has_mesh(i, look, hits):
        mesh = mesh_point(i, look.transmittance, rays, hits, scene, scene[0].splats.shape[0])
        if mesh.exists != 0:
            light += by_samples(mesh, rays.pixel_key[i], nothing_blocks, scene)
    light_inout[i] = light
