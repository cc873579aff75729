"""Kernels for relit splat sets: what the sets add to pixels that also show other sets, and the sets' mean surface.

Splats are composited a second time, with other values in place of their colours and normals. The equations are in
docs/adr/0021-captured-or-relit-per-set.md and docs/method/rasterisation.md#weighted-mean-surface.
"""

import warp as wp

from lumisplat.device.camera.pixels import (
    TILE_PIXELS,
    full_pixel_of_index,
    is_in_window,
    is_listed,
    ray_index,
    tile_pixel,
)
from lumisplat.device.light.splat_surface import finish_of
from lumisplat.device.splat.blending import instance_of, pixel_ray
from lumisplat.device.splat.ellipse import first_touching, pixel_at
from lumisplat.device.splat.projection import depth_plane
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData
from lumisplat.device.structs.shading import ShadingScene

OPTIONS = {"enable_backward": False}
wp.set_module_options(OPTIONS)

# Relit sets mixed with others. Only tiles with splats of both kinds are composited a second time.


@wp.func
def is_relit(instances: wp.array[SplatInstanceData], splat: int) -> bool:
    """Returns whether a splat belongs to a relit set."""
    return instances[instance_of(instances, splat)].relit != 0


@wp.kernel
def count_mixed(
    start: int,
    instances: wp.array[SplatInstanceData],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    counts_out: wp.array[int],
):
    """Per tile: writes its number of splats if it lists splats of relit sets and of other sets, else 0."""
    tile = start + wp.tid()
    begin = tile_starts[tile]
    end = tile_starts[tile + 1]
    counts_out[tile] = 0
    if begin < end:
        first_is_relit = is_relit(instances, tile_splats[begin])
        j = begin + 1
        while j < end:
            if is_relit(instances, tile_splats[j]) != first_is_relit:
                counts_out[tile] = end - begin
                j = end
            j += 1


@wp.kernel
def list_mixed(
    start: int,
    instances: wp.array[SplatInstanceData],
    splats: wp.array[Splat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    mixed_starts: wp.array[int],
    mixed_splats_out: wp.array[int],
    splats_out: wp.array[Splat],
):
    """Per tile with both relit and other splats: lists its splats, and writes copies for compositing relit ones alone.

    Copies of splats in relit sets have the normal (1, 0, 0); other copies are black and have a normal of zero. Tiles
    that share a splat write equal values.
    """
    tile = start + wp.tid()
    shift = tile_starts[tile] - mixed_starts[tile]
    for j in range(mixed_starts[tile], mixed_starts[tile + 1]):
        index = tile_splats[j + shift]
        splat = splats[index]
        splat.normal = wp.vec3(1.0, 0.0, 0.0)
        if not is_relit(instances, index):
            splat.color = wp.vec3(0.0)
            splat.normal = wp.vec3(0.0)
        splats_out[index] = splat
        mixed_splats_out[j] = index


@wp.kernel
def find_relit(
    start: int,
    camera: wp.array[CameraData],
    instances: wp.array[SplatInstanceData],
    splats: wp.array[Splat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    mixed_starts: wp.array[int],
    meshes: MeshPixels,
    relit: GaussianHits,
    hits_inout: GaussianHits,
):
    """Writes the colour, weight and surface Gaussian that relit sets contribute to a pixel's ray.

    Args:
        start: Offset added to the thread index, which is tile * 256 + pixel of the tile.
        camera: The view.
        instances: Instances of the splats.
        splats: Splats as written by ``list_mixed``.
        tile_starts: First entry of each tile.
        tile_splats: Indices of splats, tile after tile.
        mixed_starts: First entry of each tile among the lists of mixed tiles.
        meshes: Meshes; splats behind them do not count.
        relit: Result of compositing the copies from ``list_mixed`` in mixed tiles.
        hits_inout: Hits of all splats; receives the contribution of relit sets.
    """
    i = start + wp.tid()
    view = camera[0]
    position = tile_pixel(view, i)
    x = position[0]
    y = position[1]
    if not is_in_window(view, x, y):
        return
    ray = ray_index(view, x, y)
    tile = i // TILE_PIXELS
    begin = tile_starts[tile]
    end = tile_starts[tile + 1]
    color = wp.vec3(0.0)
    weight = float(0.0)
    gaussian = int(-1)
    if mixed_starts[tile] < mixed_starts[tile + 1]:
        if relit.normal[ray][0] > 0.0:
            surface = hits_inout.gaussian[ray]
            if hits_inout.depth[ray] < wp.inf and splats[surface].normal[0] > 0.0:
                gaussian = surface
            else:
                gaussian = first_touching(splats, tile_splats, begin, end, pixel_at(view, meshes, x, y), True)
        if gaussian >= 0:
            color = relit.color[ray]
            weight = relit.normal[ray][0]
    elif begin < end:
        if is_relit(instances, tile_splats[begin]):
            color = hits_inout.color[ray]
            weight = 1.0 - hits_inout.transmittance[ray]
            gaussian = hits_inout.gaussian[ray]
    hits_inout.relit_color[ray] = color
    hits_inout.relit_weight[ray] = weight
    hits_inout.relit_gaussian[ray] = gaussian


# The weighted-mean surface of relit Gaussians.

MEANS = wp.get_module(f"{__name__}.means")
wp.set_module_options(OPTIONS, MEANS)


@wp.kernel(module=MEANS)
def write_surface_attributes(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    scene: wp.array[ShadingScene],
    assets: wp.array[GaussianData],
    rects: wp.array[TileRect],
    splats_inout: wp.array[Splat],
):
    """Per Gaussian: replaces its splat's colour by its depth plane, and its normal by (roughness, metallic, 1).

    Compositing these splats gives weighted sums. The depth plane is the vector k with view depth ``dot(k, r)`` on
    camera ray r. Gaussians of sets that are not relit become black and do not count.
    """
    i = start + wp.tid()
    if not is_listed(rects[i]):
        return
    number = instance_of(scene[0].splats, i)
    color = wp.vec3(0.0)
    normal = wp.vec3(0.0)
    if scene[0].splats[number].relit != 0:
        instance = scene[0].splats[number]
        gaussian = i - instance.first
        finish = finish_of(number, gaussian, scene)
        color = depth_plane(camera[0], settings[0].dilation, instance, assets[instance.asset], gaussian)
        normal = wp.vec3(finish[0], finish[1], 1.0)
    splats_inout[i].color = color
    splats_inout[i].normal = normal


@wp.kernel(module=MEANS)
def store_means(
    start: int,
    camera: wp.array[CameraData],
    meshes: MeshPixels,
    sums: GaussianHits,
    hits_inout: GaussianHits,
):
    """Per pixel: stores the weighted means of depth, roughness and metallic of its relit Gaussians.

    Args:
        start: Offset added to the thread index.
        camera: The view.
        meshes: Meshes, which bound the surface depth.
        sums: Result of compositing the splats that ``write_surface_attributes`` wrote.
        hits_inout: Hits of the rays; receives the means.
    """
    i = start + wp.tid()
    at = full_pixel_of_index(camera[0], i)
    ray = ray_index(camera[0], at[0], at[1])
    weight = sums.normal[ray][2]
    depth = float(wp.inf)
    finish = wp.vec2(0.0)
    if weight > 0.0:
        direction = pixel_ray(camera[0], at[0], at[1])
        depth_z = wp.dot(sums.color[ray], direction) / weight
        depth = wp.clamp(depth_z, camera[0].near, meshes.depth_z[i]) * wp.length(direction)
        finish = wp.vec2(sums.normal[ray][0], sums.normal[ray][1]) / weight
    hits_inout.mean_depth[ray] = depth
    hits_inout.mean_finish[ray] = finish
