"""Depth of the rasterised surface: where the picked Gaussian responds most on the pixel's ray.

The equations are in docs/method/rasterisation.md#iso-opacity-surface.
"""

import warp as wp

from lumisplat.constants import SURFACE_DEPTH_SCALES
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False})

SCALES_MAX = wp.constant(wp.float32(SURFACE_DEPTH_SCALES))


@wp.func
def peak_depth(
    camera: wp.array[CameraData],
    instances: wp.array[SplatInstanceData],
    assets: wp.array[GaussianData],
    number: int,
    i: int,
    ray: wp.vec3,
    mean_z: float,
    mesh_z: float,
) -> float:
    """View depth at which a Gaussian responds most on a pixel's ray, before the mesh behind it.

    No farther from the Gaussian's mean than it reaches: dilated splats show in pixels that their Gaussian misses.

    Args:
        camera: The camera.
        instances: All instances.
        assets: All assets.
        number: The Gaussian's instance.
        i: The Gaussian, in its asset.
        ray: Of the pixel, camera space, z = 1.
        mean_z: View depth of its mean.
        mesh_z: View depth of the mesh in the pixel; inf: none.
    """
    # Fields are read one by one: copying these structs for each pixel would cost more than the depth.
    asset = instances[number].asset
    scale = assets[asset].scales[i]
    turn = assets[asset].rotations[i]
    along = wp.quat_rotate_inv(turn, instances[number].object_from_world * (camera[0].world_from_camera * ray))
    away = wp.quat_rotate_inv(turn, assets[asset].means[i] - instances[number].eye)
    # Canonical space times the smallest scale: flat Gaussians stay inside float32.
    ratio = wp.cw_div(wp.vec3(wp.min(scale)), scale)
    along = wp.cw_mul(ratio, along)
    beyond = wp.dot(wp.cw_mul(ratio, away), along) / wp.length_sq(along) - mean_z
    if not wp.isfinite(beyond):
        beyond = float(0.0)
    reach = SCALES_MAX * instances[number].scale * wp.max(scale) / wp.length(ray)
    return wp.clamp(mean_z + wp.clamp(beyond, -reach, reach), camera[0].near, mesh_z)
