"""The weighted-mean surface of the relit Gaussians in each pixel (docs/method/rasterisation.md#weighted-mean-surface).

The splats are composited once more, with what is to be averaged in place of their colours and normals.
"""

import warp as wp

from lumisplat.device.camera.pixels import is_listed, ray_index, shown_pixel
from lumisplat.device.light.splat_surface import finish_of
from lumisplat.device.splat.blending import instance_of, pixel_ray
from lumisplat.device.splat.projection import depth_plane
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import GaussianData
from lumisplat.device.structs.shading import ShadingScene

wp.set_module_options({"enable_backward": False})


@wp.kernel
def show_surfaces(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    scene: wp.array[ShadingScene],
    assets: wp.array[GaussianData],
    rects: wp.array[TileRect],
    splats_inout: wp.array[Splat],
):
    """Item = Gaussian of the scene: its depth becomes its colour, and its finish, with a one, its normal.

    Those of sets that are not relit become black: they do not count.
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


@wp.kernel
def store_means(
    start: int,
    camera: wp.array[CameraData],
    meshes: MeshPixels,
    sums: GaussianHits,
    hits_inout: GaussianHits,
):
    """Item = pixel: the mean of what ``show_surfaces`` has written, of the splats of its ray.

    Args:
        start: First item.
        camera: The view.
        meshes: The surface is before them.
        sums: These splats, composited.
        hits_inout: Of the rays; receives the means.
    """
    i = start + wp.tid()
    at = shown_pixel(camera[0], i)
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
