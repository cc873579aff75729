"""Cameras: rays of pinhole, fisheye and orthographic cameras, lens distortion, and projection of points.

Cameras support a thin lens and a rolling shutter. The equations are in docs/method/ray_tracing.md#camera-rays.
"""

import math

import warp as wp

from lumisplat.constants import DISTORTION_STEPS
from lumisplat.device.camera.pixels import full_image_index
from lumisplat.device.math.random import LENS_ANGLE, LENS_RADIUS, draw, sample_key_of
from lumisplat.device.structs.camera import CameraData, SampleData
from lumisplat.device.structs.rays import Ray

DISTORTION_RESIDUAL_FLOAT = 2e-6
"""Largest error of the inverse distortion that counts as converged, relative to 1 + the radius of the point.

It corresponds to 16 roundings of float32, a hundredth of a pixel of the largest images."""

SHUTTER_STEPS = 5
"""Number of fixed-point iterations that find the row that exposes a point with a rolling shutter (as in 3DGUT).

The row gives the time at which the point is exposed."""

# --- Lens distortion, and its inverse by Newton's method (docs/method/ray_tracing.md#distortion) ---

STEPS = wp.constant(DISTORTION_STEPS)

RESIDUAL = wp.constant(wp.float32(DISTORTION_RESIDUAL_FLOAT))


@wp.func
def distorted(camera: CameraData, point: wp.vec2) -> wp.vec2:
    """Applies the lens distortion to an undistorted point of the image plane, x/z and y/z for a pinhole."""
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
    """Returns the 2 x 2 Jacobian of ``distorted``, the lens distortion, at an undistorted point."""
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
    """Clamps an undistorted point to the radius up to which the lens distortion is one-to-one."""
    radius = wp.length(point)
    return wp.where(radius > camera.distortion_reach, point * (camera.distortion_reach / radius), point)


@wp.func
def undistorted(camera: CameraData, shown: wp.vec2) -> wp.vec2:
    """Inverts the lens distortion at point ``shown`` by Newton's method; NaN if no undistorted point maps to it."""
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
    """Returns a point of the unit disk, uniform in area for uniform ``u`` and ``v`` in [0, 1)."""
    radius = wp.sqrt(u)
    return wp.vec2(radius * wp.cos(2.0 * PI * v), radius * wp.sin(2.0 * PI * v))


@wp.func
def rotated(vector: wp.vec3, axis: wp.vec3, angle: float) -> wp.vec3:
    """Rotates a vector about a unit axis by an angle in radians (Rodrigues); exact for an angle of 0."""
    across = wp.cross(axis, vector)
    half = wp.sin(0.5 * angle)
    return vector + wp.sin(angle) * across + 2.0 * half * half * wp.cross(axis, across)


@wp.func
def pixel_spread(camera: CameraData, u: float, v: float) -> float:
    """Returns the square root of a pixel's solid angle, radians, at point (u, v) of the undistorted image plane.

    It is 0 for the parallel rays of an orthographic camera.
    """
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
    """Generates the ray of a sample through pixel (x, y); its direction is zero outside the view of a fisheye or lens.

    With an aperture, the ray starts on the lens and crosses the pinhole ray at the focus plane, perpendicular to the
    axis. A fisheye may see behind itself: its focus surface is therefore a sphere, and its lens is perpendicular to the
    pinhole ray.
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
    """Projects a world-space point to pixels, without depth of field; NaN if it is not visible.

    With a rolling shutter, the camera's pose is that of the first row.
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


# --- Projection beyond the image's edge, with a rolling shutter (docs/method/unscented.md#projection) ---

ROW_STEPS = wp.constant(SHUTTER_STEPS)


@wp.func
def image_point(camera: CameraData, field: float, view: wp.vec3) -> wp.vec2:
    """Projects a camera-space point of a pinhole or fisheye to pixels, extended beyond the field of view.

    The extended projection moves outwards with the angle from the axis everywhere, so that invisible points never fall
    inside the image. Beyond ``field``, the tangent of an angle, the projection of a pinhole is linear in the angle.
    Beyond the radius up to which the lens polynomial is monotonic, points are displaced without further distortion.
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
    """Returns the shutter time of image row ``y``: 0 for the first row, 1 for the last."""
    return wp.clamp(y / float(camera.full_height), 0.0, 1.0)


@wp.func
def view_at(camera: CameraData, point: wp.vec3, time: float) -> wp.vec3:
    """Transforms a point to camera space at shutter time ``time``: 0 at the first row, 1 at the last.

    ``point`` is relative to the eye at the start of the first row, in world orientation.
    """
    if camera.shutter != 0:
        point = rotated(point - time * camera.motion, camera.rotation_axis, -time * camera.rotation_angle)
    return wp.transpose(camera.world_from_camera) * point


@wp.func
def pixel_at_row_time(camera: CameraData, field: float, point: wp.vec3) -> wp.vec3:
    """Projects a point with a rolling shutter: returns x and y in pixels, and the last iteration's change of position.

    Each row sees the point at another position, so the row that shows it is found by fixed-point iteration. ``field``
    is the tangent of the off-axis angle beyond which a pinhole is extended linearly. ``point`` is relative to the eye
    at the start of the first row, in world orientation.
    """
    at = image_point(camera, field, view_at(camera, point, 0.5))
    error = float(0.0)
    if camera.shutter != 0:
        for _ in range(ROW_STEPS):
            before = at
            at = image_point(camera, field, view_at(camera, point, row_time(camera, before[1])))
            error = wp.length(at - before)
    return wp.vec3(at[0], at[1], error)
