"""Kernels for ``NormalMethod.ELLIPSOID``: ellipsoids of rasterised Gaussians, and normals of sampled ones.

Only frames with these normals load them. The equations are in docs/method/gaussians.md#normals.
"""

import warp as wp

from lumisplat.device.camera.pixels import full_pixel_of_index, is_listed, ray_index
from lumisplat.device.splat.blending import instance_of, pixel_ray
from lumisplat.device.splat.ellipsoid import normal_on_ray, splat_ellipsoid
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import SplatEllipsoid, TileRect
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def find_ellipsoids(
    start: int,
    camera: wp.array[CameraData],
    dilation: float,
    instances: wp.array[SplatInstanceData],
    assets: wp.array[GaussianData],
    rects: wp.array[TileRect],
    ellipsoids_out: wp.array[SplatEllipsoid],
):
    """Per Gaussian that a tile lists: writes the ellipsoid at which it ends; ``dilation`` is as for ellipsoids."""
    i = start + wp.tid()
    if is_listed(rects[i]):
        instance = instances[instance_of(instances, i)]
        gaussians = assets[instance.asset]
        ellipsoids_out[i] = splat_ellipsoid(camera[0], dilation, instance, gaussians, i - instance.first)


@wp.kernel
def set_hit_normals(
    start: int,
    camera: wp.array[CameraData],
    ellipsoids: wp.array[SplatEllipsoid],
    hits_inout: GaussianHits,
):
    """Per pixel that shows one opaque Gaussian: replaces the normal of its splat by that of its ellipsoid."""
    at = full_pixel_of_index(camera[0], start + wp.tid())
    hit = ray_index(camera[0], at[0], at[1])
    if hits_inout.gaussian[hit] >= 0:
        direction = camera[0].world_from_camera * pixel_ray(camera[0], at[0], at[1])
        normal = hits_inout.normal[hit]
        index = hits_inout.gaussian[hit]
        hits_inout.normal[hit] = normal_on_ray(ellipsoids, index, wp.vec3(0.0), direction, normal)
