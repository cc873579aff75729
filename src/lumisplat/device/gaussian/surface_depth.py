"""Depth of the surface: where the picked Gaussian itself, whatever footprint widens it, responds most on the ray.

The equations are in docs/method/rasterisation.md#iso-opacity-surface.
"""

import warp as wp

from lumisplat.constants import SURFACE_DEPTH_SCALES
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False})

SCALES_MAX = wp.constant(wp.float32(SURFACE_DEPTH_SCALES))


@wp.func
def surface_peak(
    rotation: wp.quat, scale: wp.vec3, away: wp.vec3, along: wp.vec3, middle: float, largest_scale: float
) -> float:
    """Where a Gaussian responds most on a ray, no farther from its mean than it reaches: footprints show it beyond.

    Args:
        rotation: Of the Gaussian.
        scale: Its scales.
        away: Its mean from the ray's origin, object space.
        along: Direction of the ray, object space; its length is the unit of distance.
        middle: Distance of the mean.
        largest_scale: Its largest scale, in the unit of distance.
    """
    # Canonical space times the smallest scale: flat Gaussians stay inside float32.
    ratio = wp.cw_div(wp.vec3(wp.min(scale)), scale)
    canonical = wp.cw_mul(ratio, wp.quat_rotate_inv(rotation, along))
    start = wp.cw_mul(ratio, wp.quat_rotate_inv(rotation, away))
    beyond = wp.dot(start, canonical) / wp.length_sq(canonical) - middle
    if not wp.isfinite(beyond):
        beyond = float(0.0)
    reach = SCALES_MAX * largest_scale
    return middle + wp.clamp(beyond, -reach, reach)


@wp.func
def surface_distance(
    camera: wp.array[CameraData],
    instances: wp.array[SplatInstanceData],
    assets: wp.array[GaussianData],
    number: int,
    i: int,
    ray: wp.vec3,
    distance: float,
    mesh_z: float,
) -> float:
    """Distance along a pixel's ray at which a Gaussian responds most, before the mesh behind it.

    Args:
        camera: The camera.
        instances: All instances.
        assets: All assets.
        number: The Gaussian's instance.
        i: The Gaussian, in its asset.
        ray: Of the pixel, camera space, z = 1.
        distance: Along the ray, at the view depth of its mean.
        mesh_z: View depth of the mesh in the pixel; inf: none.
    """
    # Fields are read one by one: copying these structs for each pixel would cost more than the depth.
    asset = instances[number].asset
    scale = assets[asset].scales[i]
    along = instances[number].object_from_world * (camera[0].world_from_camera * ray)
    away = assets[asset].means[i] - instances[number].eye
    length = wp.length(ray)
    largest_scale = instances[number].scale * wp.max(scale) / length
    depth_z = surface_peak(assets[asset].rotations[i], scale, away, along, distance / length, largest_scale)
    return wp.clamp(depth_z, camera[0].near, mesh_z) * length
