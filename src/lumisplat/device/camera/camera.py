"""The rays of cameras: pinhole, equidistant fisheye and orthographic, with a thin lens and a rolling shutter.

The equations are in docs/method/ray_tracing.md#camera-rays.
"""

import math

import warp as wp

from lumisplat.device.camera.distortion import undistorted
from lumisplat.device.camera.window import picture_index
from lumisplat.device.math.random import LENS_ANGLE, LENS_RADIUS, draw, sample_key_of
from lumisplat.device.structs.camera import CameraData, SampleData
from lumisplat.device.structs.rays import Ray

wp.set_module_options({"enable_backward": False})

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
def turned(vector: wp.vec3, axis: wp.vec3, angle: float) -> wp.vec3:
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
        sample_key = sample_key_of(picture_index(camera, x, y), sample.index, sample.seed)
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
        time = (float(y) + 0.5) / float(camera.picture_height)
        angle = time * camera.turn_angle
        ray.origin = (
            camera.eye + time * camera.motion + turned(camera.world_from_camera * start, camera.turn_axis, angle)
        )
        ray.direction = turned(ray.direction, camera.turn_axis, angle)
    ray.direction = wp.normalize(ray.direction)
    return ray
