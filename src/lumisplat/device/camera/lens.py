"""Where a camera's image has a point, beyond its edge too, and at the time at which its rolling shutter is there.

The equations are in docs/method/unscented.md#projection.
"""

import warp as wp

from lumisplat.constants.unscented import SHUTTER_STEPS
from lumisplat.device.camera.camera import FISHEYE, turned
from lumisplat.device.camera.distortion import distorted, within_reach
from lumisplat.device.structs.camera import CameraData

wp.set_module_options({"enable_backward": False})

STEPS = wp.constant(SHUTTER_STEPS)


@wp.func
def image_point(camera: CameraData, field: float, view: wp.vec3) -> wp.vec2:
    """Where a pinhole's or a fisheye's image has a point of camera space, pixels; never inside if it is not seen.

    It moves outwards with the angle from the axis everywhere: beyond ``field``, the tangent of an angle, a pinhole's
    points do so by the angle, and beyond where a lens's polynomial rises, all do so as without distortion.
    """
    plane = wp.vec2(view[0], view[1])
    across = wp.length(plane)
    if camera.model == FISHEYE:
        if across > 0.0:
            plane *= wp.atan2(across, view[2]) / across
        elif view[2] < 0.0:
            plane = wp.vec2(wp.pi, 0.0)
    elif across < field * view[2]:
        plane /= view[2]
    else:
        beyond = wp.atan2(across, view[2]) - wp.atan(field)
        if across > 0.0:
            plane /= across
        else:
            plane = wp.vec2(1.0, 0.0)
        plane *= field + (1.0 + field * field) * beyond
    if camera.distorted != 0:
        within = within_reach(camera, plane)
        plane = distorted(camera, within) + (plane - within)
    return wp.cw_mul(camera.focal, plane) + camera.center


@wp.func
def row_time(camera: CameraData, y: float) -> float:
    """When a place of the image is exposed, as a share of the time from the first row to the last."""
    return wp.clamp(y / float(camera.picture_height), 0.0, 1.0)


@wp.func
def view_at(camera: CameraData, point: wp.vec3, time: float) -> wp.vec3:
    """A point in camera space, given from where the eye is at the start of the first row, world space."""
    if camera.shutter != 0:
        point = turned(point - time * camera.motion, camera.turn_axis, -time * camera.turn_angle)
    return wp.transpose(camera.world_from_camera) * point


@wp.func
def seen_point(camera: CameraData, field: float, point: wp.vec3) -> wp.vec3:
    """Where the image has a point, pixels, and by how much its row has moved in the last step.

    With a rolling shutter each row sees it elsewhere: it is where the row that it is in sees it.

    Args:
        camera: The camera.
        field: As of ``image_point``.
        point: As of ``view_at``.
    """
    at = image_point(camera, field, view_at(camera, point, 0.5))
    error = float(0.0)
    if camera.shutter != 0:
        for _ in range(STEPS):
            before = at
            at = image_point(camera, field, view_at(camera, point, row_time(camera, before[1])))
            error = wp.length(at - before)
    return wp.vec3(at[0], at[1], error)
