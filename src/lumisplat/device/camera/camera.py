"""Cameras: rays of pinhole, fisheye and orthographic cameras, lens distortion, and the projection of points.

A camera has a thin lens and a rolling shutter. The equations are in docs/method/ray_tracing.md#camera-rays.
"""

import math

import warp as wp

from lumisplat.constants import DISTORTION_STEPS
from lumisplat.device.camera.pixels import full_image_index
from lumisplat.device.math.random import LENS_ANGLE, LENS_RADIUS, draw, sample_key_of
from lumisplat.device.structs.camera import CameraData, SampleData
from lumisplat.device.structs.rays import Ray

DISTORTION_RESIDUAL_FLOAT = 2e-6
"""Largest error of the inverse of a distortion in float32, relative to one plus the radius: 16 roundings, a hundredth
of a pixel of the largest images."""

SHUTTER_STEPS = 5
"""Steps in which the row that sees a point finds the time at which it is exposed. 3DGUT's number."""

# --- Lens distortion, and its inverse by Newton's method (docs/method/ray_tracing.md#distortion) ---

STEPS = wp.constant(DISTORTION_STEPS)

RESIDUAL = wp.constant(wp.float32(DISTORTION_RESIDUAL_FLOAT))


@wp.func
def distorted(camera: CameraData, point: wp.vec2) -> wp.vec2:
    """Where the lens shows a point, both in the coordinates of the camera's model."""
    k = camera.radial
    p = camera.tangential
    u = point[0]
    v = point[1]
    s = u * u + v * v
    radial = 1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))
    return wp.vec2(
        u * radial + 2.0 * p[0] * u * v + p[1] * (s + 2.0 * u * u),
        v * radial + 2.0 * p[1] * u * v + p[0] * (s + 2.0 * v * v),
    )


@wp.func
def distortion_jacobian(camera: CameraData, point: wp.vec2) -> wp.mat22:
    """Derivative of ``distorted``."""
    k = camera.radial
    p = camera.tangential
    u = point[0]
    v = point[1]
    s = u * u + v * v
    radial = 1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3])))
    slope = 2.0 * (k[0] + s * (2.0 * k[1] + s * (3.0 * k[2] + s * 4.0 * k[3])))
    mixed = slope * u * v + 2.0 * (p[0] * u + p[1] * v)
    return wp.mat22(
        radial + slope * u * u + 2.0 * p[0] * v + 6.0 * p[1] * u,
        mixed,
        mixed,
        radial + slope * v * v + 2.0 * p[1] * u + 6.0 * p[0] * v,
    )


@wp.func
def within_reach(camera: CameraData, point: wp.vec2) -> wp.vec2:
    """A point, moved to where the polynomial still rises."""
    radius = wp.length(point)
    return wp.where(radius > camera.distortion_reach, point * (camera.distortion_reach / radius), point)


@wp.func
def undistorted(camera: CameraData, shown: wp.vec2) -> wp.vec2:
    """What the lens shows at a point; NaN where it shows nothing."""
    found = within_reach(camera, shown)
    for _ in range(STEPS):
        step = wp.inverse(distortion_jacobian(camera, found)) * (distorted(camera, found) - shown)
        found = within_reach(camera, found - step)
    error = distorted(camera, found) - shown
    if not wp.max(wp.abs(error[0]), wp.abs(error[1])) <= RESIDUAL * (1.0 + wp.length(shown)):
        found = wp.vec2(wp.nan, wp.nan)
    return found


# --- Rays ---

PINHOLE: int = wp.constant(0)

FISHEYE: int = wp.constant(1)

ORTHOGRAPHIC: int = wp.constant(2)

PI = wp.constant(wp.float32(math.pi))


@wp.func
def disk_point(u: float, v: float) -> wp.vec2:
    """A point of the unit disk, uniform over its area for uniform ``u`` and ``v`` in [0, 1)."""
    radius = wp.sqrt(u)
    return wp.vec2(radius * wp.cos(2.0 * PI * v), radius * wp.sin(2.0 * PI * v))


@wp.func
def rotated(vector: wp.vec3, axis: wp.vec3, angle: float) -> wp.vec3:
    """A vector rotated about a unit axis by an angle in radians (Rodrigues); exactly the vector for an angle of 0."""
    across = wp.cross(axis, vector)
    half = wp.sin(0.5 * angle)
    return vector + wp.sin(angle) * across + 2.0 * half * half * wp.cross(axis, across)


@wp.func
def pixel_spread(camera: CameraData, u: float, v: float) -> float:
    """Root of the solid angle of a pixel at a point of the undistorted image plane, radians; 0 for parallel rays."""
    per_pixel = 1.0 / (camera.focal[0] * camera.focal[1])
    if camera.model == ORTHOGRAPHIC:
        return float(0.0)
    if camera.model == FISHEYE:
        theta = wp.sqrt(u * u + v * v)
        if theta > 0.0:
            per_pixel *= wp.max(wp.sin(theta), 0.0) / theta
        return wp.sqrt(per_pixel)
    cosine = 1.0 / wp.sqrt(1.0 + u * u + v * v)
    return wp.sqrt(per_pixel * cosine * cosine * cosine)


@wp.func
def camera_ray(camera: CameraData, sample: SampleData, x: int, y: int) -> Ray:
    """The ray of a sample through a pixel; its direction is zero where a fisheye or a distorting lens sees nothing.

    With an aperture it starts on the lens and crosses the ray through the lens's centre where that is in focus: on a
    plane perpendicular to the axis; for a fisheye, which may see behind itself, on a sphere, with the lens
    perpendicular to that ray.
    """
    ray = Ray()
    u = (float(x) + camera.offset[0] - camera.center[0]) / camera.focal[0]
    v = (float(y) + camera.offset[1] - camera.center[1]) / camera.focal[1]

    if camera.distorted != 0:
        point = undistorted(camera, wp.vec2(u, v))
        u = point[0]
        v = point[1]
        if wp.isnan(u):
            return ray

    ray.spread = pixel_spread(camera, u, v)
    start = wp.vec3(0.0, 0.0, 0.0)
    direction = wp.vec3(0.0, 0.0, 1.0)
    right = wp.vec3(1.0, 0.0, 0.0)
    down = wp.vec3(0.0, 1.0, 0.0)
    if camera.model == FISHEYE:
        theta = wp.sqrt(u * u + v * v)
        if theta > PI:
            return ray
        if theta > 0.0:
            outward = wp.vec3(u / theta, v / theta, 0.0)
            direction = wp.sin(theta) * outward + wp.cos(theta) * direction
            right = wp.vec3(-outward[1], outward[0], 0.0)
            down = wp.cross(direction, right)
    elif camera.model == ORTHOGRAPHIC:
        start = wp.vec3(u, v, 0.0)
    else:
        direction = wp.normalize(wp.vec3(u, v, 1.0))

    if camera.aperture > 0.0:
        sample_key = sample_key_of(full_image_index(camera, x, y), sample.index, sample.seed)
        point = camera.aperture * disk_point(draw(sample_key, LENS_RADIUS), draw(sample_key, LENS_ANGLE))
        shift = point[0] * right + point[1] * down
        sharp = camera.focus_distance
        if camera.model != FISHEYE:
            sharp /= direction[2]
        start += shift
        direction = wp.normalize(sharp * direction - shift)

    ray.t_min = camera.near
    if camera.model != FISHEYE:
        ray.t_min /= direction[2]
    ray.origin = camera.eye + camera.world_from_camera * start
    ray.direction = camera.world_from_camera * direction
    if camera.shutter != 0:
        time = (float(y) + 0.5) / float(camera.full_height)
        angle = time * camera.rotation_angle
        ray.origin = (
            camera.eye + time * camera.motion + rotated(camera.world_from_camera * start, camera.rotation_axis, angle)
        )
        ray.direction = rotated(ray.direction, camera.rotation_axis, angle)
    ray.direction = wp.normalize(ray.direction)
    return ray


# --- Projection of points: the inverse of rays ---


@wp.func
def pixel_of_point(camera: CameraData, point: wp.vec3) -> wp.vec2:
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


# --- Projection beyond the image's edge, at the time of the rolling shutter (docs/method/unscented.md#projection) ---

ROW_STEPS = wp.constant(SHUTTER_STEPS)


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
    return wp.clamp(y / float(camera.full_height), 0.0, 1.0)


@wp.func
def view_at(camera: CameraData, point: wp.vec3, time: float) -> wp.vec3:
    """A point in camera space, given from where the eye is at the start of the first row, world space."""
    if camera.shutter != 0:
        point = rotated(point - time * camera.motion, camera.rotation_axis, -time * camera.rotation_angle)
    return wp.transpose(camera.world_from_camera) * point


@wp.func
def pixel_at_row_time(camera: CameraData, field: float, point: wp.vec3) -> wp.vec3:
    """Where the image has a point, pixels, and by how much its row has moved in the last step.

    With a rolling shutter each row sees it elsewhere: it is where the row that it is in sees it.

    ``field`` is as of ``image_point``, ``point`` as of ``view_at``.
    """
    at = image_point(camera, field, view_at(camera, point, 0.5))
    error = float(0.0)
    if camera.shutter != 0:
        for _ in range(ROW_STEPS):
            before = at
            at = image_point(camera, field, view_at(camera, point, row_time(camera, before[1])))
            error = wp.length(at - before)
    return wp.vec3(at[0], at[1], error)
