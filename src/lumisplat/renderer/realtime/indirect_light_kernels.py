"""Kernels of indirect light from screen probes and the radiance cache (docs/method/realtime.md)."""

import warp as wp

from lumisplat.device.gaussian.layers import above_layer
from lumisplat.device.gi.probe_placement import ProbeData, ProbeGrid, ProbeLight
from lumisplat.device.gi.radiance_cache import CachePoints, CacheSamples
from lumisplat.device.gi.screen_probes import gathered_light
from lumisplat.device.gi.secondary_rays import LobeRays, lobe_radiance, lobe_share
from lumisplat.device.gi.surfaces import SurfaceLight, SurfacePixels, is_sampled_in_frame
from lumisplat.device.material.bsdf import facet_mirrored
from lumisplat.device.material.microfacets import ALPHA_GGX_MIN
from lumisplat.device.math.color import is_black
from lumisplat.device.math.directions import INV_PI, around
from lumisplat.device.math.random import branch_key, pixel_key_of, sobol_2d
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.rays import RayData

wp.set_module_options({"enable_backward": False})

RAY_LIFT = 1e-4
"""Height above a mesh at which rays from cache cells start, as a fraction of the origin's largest coordinate, so that
rounding does not put the origin below the surface. The rounding error is not computed, because the cache stores no
triangles."""

LIFT = wp.constant(wp.float32(RAY_LIFT))
GLOSSY_SEED = wp.constant(wp.uint32(0x676C6F73))
"""Number mixed into the random seed of look-ups within highlights, so that their seed differs from that of other
look-ups."""


@wp.kernel
def choose_surfaces(start: int, splats: SurfacePixels, meshes: SurfacePixels, larger_out: SurfacePixels):
    """Per pixel: copies the surface of Gaussians or the mesh surface, whichever covers more of the pixel."""
    pixel = start + wp.tid()
    chosen = splats
    if meshes.share[pixel] > splats.share[pixel]:
        chosen = meshes
    larger_out.share[pixel] = chosen.share[pixel]
    larger_out.position[pixel] = chosen.position[pixel]
    larger_out.normal[pixel] = chosen.normal[pixel]
    larger_out.distance[pixel] = chosen.distance[pixel]
    larger_out.extent[pixel] = chosen.extent[pixel]
    larger_out.previous[pixel] = chosen.previous[pixel]


@wp.kernel
def start_cache_rays(start: int, offset: float, points: CachePoints, rays_out: RayData):
    """Per ray: starts it at its point of the radiance cache, in a cosine-weighted direction; without point, inactive.

    Gaussians within ``offset`` times the scale of the point's Gaussian do not block the ray.
    """
    i = start + wp.tid()
    rays_out.is_active[i] = False
    if i >= points.is_active.shape[0]:
        return
    if not points.is_active[i]:
        return
    key = points.key[i]
    rays_out.is_active[i] = True
    normal = points.normal[i]
    position = points.position[i]
    near = offset * points.extent[i]
    if points.extent[i] == 0.0:
        position += LIFT * wp.max(wp.abs(position)) * normal
    u = sobol_2d(key, points.ray[i])
    rays_out.origin[i] = above_layer(position, normal, near)
    rays_out.direction[i] = around(normal, wp.sqrt(1.0 - u[0]), wp.sqrt(u[0]), u[1])
    rays_out.t_min[i] = near
    rays_out.normal[i] = normal
    rays_out.t_max[i] = wp.inf
    rays_out.path_length[i] = 0.0
    rays_out.spread[i] = 0.0
    rays_out.sample_key[i] = branch_key(key, points.ray[i])
    rays_out.pixel_key[i] = rays_out.sample_key[i]
    rays_out.sample[i] = 0


@wp.kernel
def add_direct(start: int, samples: CacheSamples, reflected_inout: wp.array[wp.vec3]):
    """Per ray: adds to ``reflected_inout`` the sampled direct light that the surface at the ray's hit reflects."""
    i = start + wp.tid()
    if samples.is_active[i]:
        reflected_inout[i] += samples.radiance[i]


@wp.func
def reflected_direction(pixel: int, key: wp.uint32, frame: int, view: wp.vec3, surfaces: SurfacePixels) -> wp.vec3:
    """Samples a unit direction within the highlight of a pixel's surface."""
    normal = surfaces.normal[pixel]
    alpha = wp.max(surfaces.alpha[pixel], ALPHA_GGX_MIN)
    facet = facet_mirrored(normal, view, alpha, sobol_2d(key, frame))
    direction = 2.0 * wp.dot(view, facet) * facet - view
    if wp.dot(direction, normal) <= 0.0:
        direction = 2.0 * wp.dot(view, normal) * normal - view
    return direction


@wp.func
def radiance_of_probes(
    pixel: int,
    grids: wp.array[ProbeGrid],
    camera: wp.array[CameraData],
    surfaces: SurfacePixels,
    probes: ProbeData,
    adaptive_of: wp.array[int],
    probe_light: ProbeLight,
) -> wp.vec3:
    """Returns the radiance that screen probes hold for a random direction within the highlight of a pixel's surface."""
    view = wp.normalize(camera[0].eye - surfaces.position[pixel])
    key = pixel_key_of(pixel, wp.bit_xor(grids[0].seed, GLOSSY_SEED))
    direction = reflected_direction(pixel, key, grids[0].frame, view, surfaces)
    at = wp.vec2(float(pixel % grids[0].width) + 0.5, float(pixel // grids[0].width) + 0.5)
    return gathered_light(
        pixel, at, direction, True, grids[0], camera[0], surfaces, probes, adaptive_of, probe_light
    ).total


@wp.kernel
def gather_light(
    start: int,
    slot: int,
    grids: wp.array[ProbeGrid],
    camera: wp.array[CameraData],
    surfaces: SurfacePixels,
    probes: ProbeData,
    adaptive_of: wp.array[int],
    probe_light: ProbeLight,
    irradiance: wp.array[wp.vec3],
    lobes: LobeRays,
    interval: int,
    light_out: SurfaceLight,
):
    """Per pixel: computes the indirect light, from probes and from rays in highlights, that its surface reflects.

    Args:
        start: Offset added to the thread index.
        slot: Kind of the surfaces, 0 splats or 1 meshes.
        grids: Layout of the probes.
        camera: Camera of the frame.
        surfaces: Surfaces of the pixels.
        probes: The probes.
        adaptive_of: Adaptive probe of each tile.
        probe_light: Radiance of the probes.
        irradiance: Irradiance of the surfaces, from the probes.
        lobes: Rays within highlights.
        interval: Number of frames from one sample of a pixel to the next, 1 or 2.
        light_out: Diffuse light divided by the albedo, and glossy light.
    """
    pixel = start + wp.tid()
    width = grids[0].width
    sampled = surfaces.share[pixel] > 0.0 and is_sampled_in_frame(
        pixel % width, pixel // width, interval, grids[0].frame
    )
    light_out.is_sampled[pixel] = sampled
    light_out.diffuse[pixel] = INV_PI * irradiance[pixel]
    light_out.glossy[pixel] = wp.vec3(0.0)
    if not sampled or is_black(surfaces.glossy_albedo[pixel]):
        return
    share = lobe_share(surfaces.alpha[pixel])
    reflected = wp.vec3(0.0)
    if share > 0.0:
        found = lobe_radiance(pixel, slot, camera, surfaces, lobes)
        share *= found[3]
        reflected = share * wp.vec3(found[0], found[1], found[2])
    if share < 1.0:
        reflected += (1.0 - share) * radiance_of_probes(
            pixel, grids, camera, surfaces, probes, adaptive_of, probe_light
        )
    light_out.glossy[pixel] = wp.cw_mul(surfaces.glossy_albedo[pixel], reflected)
