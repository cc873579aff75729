"""Where a camera sees a point: the inverse of its rays (docs/method/ray_tracing.md#camera-rays)."""

import warp as wp

from lumisplat.device.camera.camera import FISHEYE, ORTHOGRAPHIC
from lumisplat.device.camera.distortion import distorted, within_reach
from lumisplat.device.structs.camera import CameraData

wp.set_module_options({"enable_backward": False})


@wp.func
def seen_at(camera: CameraData, point: wp.vec3) -> wp.vec2:
    """Where a camera sees a point of the world, pixels; NaN where it does not.

    Through the centre of its lens, and with a rolling shutter as the first row sees it.
    """
    nowhere = wp.vec2(wp.nan, wp.nan)
    view = wp.transpose(camera.world_from_camera) * (point - camera.eye)
    plane = wp.vec2(view[0], view[1])
    if camera.model == FISHEYE:
        across = wp.length(plane)
        if across > 0.0:
            plane *= wp.atan2(across, view[2]) / across
    elif camera.model != ORTHOGRAPHIC:
        if view[2] <= 0.0:
            return nowhere
        plane /= view[2]
    if camera.distorted != 0:
        if wp.length_sq(within_reach(camera, plane) - plane) > 0.0:
            return nowhere
        plane = distorted(camera, plane)
    return wp.cw_mul(camera.focal, plane) + camera.center
